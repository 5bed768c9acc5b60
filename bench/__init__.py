"""Comparisons with other programs, by time, memory and error; nothing here is installed with the package."""
