"""Every target there is."""

import pkgutil

import bench.fuzz
from bench.fuzz.campaign import main

TARGETS = {"calls", "files"}
"""Modules here that have targets."""

if __name__ == "__main__":
    main([f"bench.fuzz.{m.name}" for m in pkgutil.iter_modules(bench.fuzz.__path__) if m.name in TARGETS], bench.fuzz.__doc__)
