"""The notebooks of the course run as scripts, write nothing, and what they print is true."""

import re
from pathlib import Path

import pytest
from scripts import Runner

COURSE = Path(__file__).parent.parent / "examples" / "course"
NOTEBOOKS = sorted(path.name for path in COURSE.glob("[0-9][0-9]_*.py"))

TRUTHS: dict[str, list[tuple[str, float, float]]] = {
    "01_projection_and_cameras.py": [
        (r"pixels to rays and back: ([\d.e+-]+)", 0, 1e-9),
        (r"turn about y: correlation of arrows with 1 / depth (-?[\d.]+)", -0.1, 0.1),
        (r"step 5: rms error +([\d.]+)", 0.45, 0.55),
        (r"step 5: .* centre off by ([\d.]+)", 0, 0.01),
    ],
    "02_homographies_and_panoramas.py": [
        (r"a hundred others of the wall agree with it to ([\d.e+-]+)", 0, 1e-9),
        (r"normalised DLT +error on the wall: median ([\d.]+)", 0.5, 1.3),
        (r"matches, .* the turn is off by ([\d.]+) degrees", 0, 0.1),
        (r"seed 2: start 2 degrees off, ([\d.]+) degrees", 0, 0.02),
    ],
    "03_epipolar_geometry.py": [
        (r"seven points from the line F x1: ([\d.e+-]+)", 0, 1e-9),
        (r"distance of exact points from the estimated F: median ([\d.]+)", 0, 0.3),
        (r"estimated as E .* rotation off by ([\d.]+) degrees", 0, 0.2),
        (r"band of 2000 trials: ([\d.]+)", 0.9, 1.1),
    ],
    "04_minimal_solvers.py": [
        (r"as many solutions as by hand, and the same but for ([\d.e+-]+)", 0, 1e-9),
        (r"seven points: .* in ([\d.]+) %", 99.9, 100),
        (r"five rays: .* in ([\d.]+) %", 99.9, 100),
        (r"through svd .* relative error: median ([\d.e+-]+)", 1, 1),
        (r"by hand against the library: ([\d.e+-]+)", 0, 1e-9),
        (r"by hand against finite differences: ([\d.e+-]+)", 0, 1e-5),
    ],
    "05_ransac.py": [
        (r"slope: true 0.556, RANSAC ([\d.]+)", 0.53, 0.58),
        (r"no loop: (\d+) % within", 93, 100),
        (r"worst of the 200 pairs ([\d.]+)", 0, 1),
        (r"([\d.]+) px if it is not", 0, 0),
    ],
    "06_triangulation_and_covariance.py": [
        (r"before the correction, ([\d.e+-]+) px after", 0, 1e-9),
        (r"cameras unlike, optimal : reprojection error ([\d.]+)", 0.93, 1.07),
        (r"baseline 2.0: .* ([\d.]+)% of the trials", 92, 98),
        (r"two ways to the covariance: ([\d.e+-]+)", 0, 1e-6),
        (r"those that agree: median point off by ([\d.]+)", 0, 0.02),
        (r"in the end: second camera off by ([\d.]+) degrees", 0, 0.5),
    ],
    "07_resection.py": [
        (r"camera_pnp: rotation off by [\d.]+ degrees in relief, ([\d.]+)", 0, 1),
        (r"derivative against finite differences: ([\d.e+-]+)", 0, 1e-5),
        (r"80 px +camera_pnp .* ([\d.]+)%\n", 0, 0),
        (r"80 px +DLT .* ([\d.]+)%\n", 30, 60),
        (r"camera_pnp: pose error .* to ([\d.]+) at the end", 0, 0.2),
        (r"camera_pnp: landmarks .* at first, (\d+) at the end", 0, 70),
        (r"DLT +: landmarks .* at first, (\d+) at the end", 100, 1e4),
    ],
    "08_bundle_adjustment.py": [
        (r"the steps differ by ([\d.e+-]+)", 0, 1e-6),
        (r"after \d+ steps: ([\d.]+) px", 0.38, 0.45),
        (r"scale: .* = ([\d.e+-]+)", 0, 1e-9),
        (r"free +: (\d+) directions free", 7, 7),
        (r"Cauchy +: points +([\d.]+)", 0, 10),
        (r"standard deviation of the angle: predicted [\d.]+ degrees, observed ([\d.]+)", 0.13, 0.27),
    ],
    "09_many_views.py": [
        (r"trifocal tensor +: +([\d.]+) px", 0.4, 1.5),
        (r"after projective bundle adjustment ([\d.]+) px", 0.5, 0.7),
        (r"autocalibration: OK\nfocal length ([\d.]+)", 980, 1020),
        (r"points off by ([\d.]+) of the cube", 0, 0.02),
        (r"moving sideways: .* DEGENERATE +f = +[\d.]+ \+- ([\d.]+)%", 5, 1e6),
        (r"turns of 28.7 degrees: f \+- ([\d.]+)", 0, 2),
    ],
    "10_lines_conics_curves.py": [
        (r"OK: direction off by ([\d.]+) degrees", 0, 2),
        (r"because of EPIPOLAR_PLANE\nat ([\d.]+) degrees", 3, 3),
        (r"OK: centre in space off by ([\d.]+)", 0, 0.01),
        (r"after the last, metric bundle adjustment: f = ([\d.]+)", 820, 880),
        (r"the scene being 2 wide\nOK: .* samples found, ([\d.]+) off", 0, 0.01),
        (r"found (-[\d.]+) \+-", -0.185, -0.175),
    ],
}
"""For a notebook, what it prints and between which numbers that must lie."""


LOOPS = {
    "02_homographies_and_panoramas.py": "align(seed) < 0.02",
    "04_minimal_solvers.py": "abs(calibrate(seed) / 900 - 1) < 0.05",
    "05_ransac.py": "(errors := train(seed))[1] < min(5, errors[0] / 3)",
    "07_resection.py": "train(seed, 1) < min(0.2, learn(layer_dlt, seed, 1)[0][-10:].mean())",
}
"""For a notebook with a loop that learns, what must hold of it whatever the seed; the first one it shows itself."""


@pytest.mark.parametrize("name", NOTEBOOKS)
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_runs_and_tells_the_truth(name: str, runner: Runner) -> None:
    text, _ = runner.run(COURSE / name)
    assert not list(runner.folder.iterdir())
    for pattern, low, high in TRUTHS.get(name, []):
        found = re.search(pattern, text)
        assert found is not None, (pattern, text)
        assert low <= float(found[1]) <= high, found[0]


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(LOOPS))
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_learning_succeeds_whatever_the_seed(name: str, runner: Runner) -> None:
    _, space = runner.run(COURSE / name)
    assert not [seed for seed in range(50) if not eval(LOOPS[name], space | {"seed": seed})]


@pytest.mark.parametrize("name", NOTEBOOKS)
def test_cells_read_the_same_in_editors_and_in_galleries(name: str) -> None:
    text = (COURSE / name).read_text()
    title, underline = text.split("\n")[1:3]
    assert re.fullmatch(r"\d+\. .+", title)
    assert underline == "=" * len(title)
    cells = re.split(r"^# %%(.*)\n", text, flags=re.M)
    for kind, body in zip(cells[1::2], cells[2::2], strict=True):
        assert kind in ("", " [markdown]")
        lines = body.strip().split("\n")
        if kind:
            assert all(line.startswith("#") for line in lines), lines[0]
        else:
            assert not lines[0].startswith("#"), lines[0]
    assert "plt.show(" not in text


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_figures_are_saved_where_told(runner: Runner) -> None:
    runner.run(COURSE / "save_figures.py", str(runner.folder / "figures"), "6")
    assert {p.name for p in runner.folder.iterdir()} == {"figures"}
    assert {p.suffix for p in (runner.folder / "figures").iterdir()} == {".png"}


def test_table_of_contents() -> None:
    assert set(re.findall(r"\((\d\d_\w+\.py)\)", (COURSE / "README.md").read_text())) >= set(NOTEBOOKS)
