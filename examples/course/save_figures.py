"""Run notebooks of the course and save their figures.

python examples/course/save_figures.py FOLDER [NUMBER ...]
"""

import runpy
import sys
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt


def main(folder: str, *numbers: str) -> None:
    """Save every figure as FOLDER/NN_name_K.png; all notebooks where no numbers are given."""
    to = Path(folder)
    to.mkdir(parents=True, exist_ok=True)
    for script in sorted(Path(__file__).parent.glob("[0-9][0-9]_*.py")):
        if numbers and script.name[:2] not in {number.zfill(2) for number in numbers}:
            continue
        runpy.run_path(str(script), run_name="__main__")
        for number in plt.get_fignums():
            plt.figure(number).savefig(to / f"{script.stem}_{number}.png", dpi=120)
        plt.close("all")


if __name__ == "__main__":
    if len(sys.argv) < 2:
        raise SystemExit(__doc__)
    main(*sys.argv[1:])
