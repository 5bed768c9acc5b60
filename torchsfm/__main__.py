"""`python -m torchsfm` is the `torchsfm` command."""

from torchsfm.cli import main

main()
