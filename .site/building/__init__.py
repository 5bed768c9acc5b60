"""The parts of the site made of something else: pages of the package's names, its files, the examples; figures."""
