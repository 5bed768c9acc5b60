"""The examples run, and what they print about themselves is true."""

import re
import runpy
from pathlib import Path

import pytest
from chance import stream_seed
from scripts import Runner

EXAMPLES = Path(__file__).parent.parent / "examples"

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning")  # as for a user


def number(pattern: str, text: str) -> float:
    found = re.search(pattern, text)
    assert found is not None, text
    return float(found[1])


def test_photographs_to_model(runner: Runner) -> None:
    text, _ = runner.run(EXAMPLES / "photographs_to_model.py")
    assert "8 of 8 images registered" in text
    assert number(r"median error: ([\d.]+) deg", text) < 0.5
    found, true = re.search(r"focal length: ([\d.]+) px, true ([\d.]+) px", text).groups()  # type: ignore[union-attr]
    assert float(found) == pytest.approx(float(true), rel=0.03)
    assert (runner.folder / "model.npz").exists()


def test_batched_ransac(runner: Runner) -> None:
    text, _ = runner.run(EXAMPLES / "batched_ransac.py")
    assert number(r"from F: median ([\d.]+) px", text) < 0.5
    assert "the first pair alone gives the same inliers: True" in text
    assert number(r"and F but for ([\d.e+-]+)", text) < 1e-8


def test_differentiable_geometry(runner: Runner) -> None:
    text, _ = runner.run(EXAMPLES / "differentiable_geometry.py")
    assert number(r"step  30: loss ([\d.]+)", text) < 1.5  # trusting the wrong matches more keeps it at 3.7
    assert number(r"all matches alike: median error ([\d.]+) px", text) > 20
    assert number(r"weights of the network: median error ([\d.]+) px", text) < 3


@pytest.mark.slow
@pytest.mark.parametrize(("name", "best"), [("differentiable_geometry", 3), ("train_match_weights", 1)])
def test_learning_succeeds_whatever_the_seed(name: str, best: float, capsys: pytest.CaptureFixture[str]) -> None:
    main = runpy.run_path(str(EXAMPLES / f"{name}.py"))["main"]
    for seed in range(50):
        main(seed=stream_seed(seed))
        assert float(re.findall(r"median error ([\d.]+)", capsys.readouterr().out)[-1]) < best, seed


def test_train_match_weights(runner: Runner) -> None:
    text, _ = runner.run(EXAMPLES / "train_match_weights.py")
    assert number(r"uniform samples: median error ([\d.]+) px", text) > 10
    assert number(r"learned samples: median error ([\d.]+) px", text) < 3
    assert number(r"with learned scores: median error ([\d.]+) px", text) < 1


def test_own_estimator(runner: Runner) -> None:
    text, _ = runner.run(EXAMPLES / "own_estimator.py")
    assert number(r"lines: .* are ([\d.]+) off", text) < 0.03
    assert number(r"similarities: ([\d.]+) off", text) < 6e-4
    assert "Unfinished lacks max_solutions, codimension, degenerate, squared_residual, step" in text


def test_ransac_variants(runner: Runner) -> None:
    text, _ = runner.run(EXAMPLES / "ransac_variants.py")
    guided, uniform = (number(rf"{name} +[\d.]+ +[\d.]+ +([\d.]+)", text) for name in ("guided by scores", "uniform"))
    assert guided < 0.7 * uniform
    best, local = (number(rf"{name} +[\d.]+ +[\d.]+ +([\d.]+)", text) for name in ("best sample", "locally optimised"))
    assert local < 0.5 * best
    assert number(r"Magsac +(?:[\d.]+ +){5}([\d.]+)", text) < 0.3
    assert {p.name for p in (runner.folder / "ransac_variants").iterdir()} == {
        "sampling.png", "scores.png", "local_optimisation.png", "time.png"
    }  # fmt: skip


def test_no_example_is_forgotten() -> None:
    tested = set(re.findall(r'run\(EXAMPLES / "(\w+\.py)"', Path(__file__).read_text()))
    assert tested == {path.name for path in EXAMPLES.glob("*.py")}


def test_nothing_known(runner: Runner) -> None:
    text, _ = runner.run(EXAMPLES / "nothing_known.py")
    around, sideways = text.split("Twelve views, moving sideways:")
    assert number(r"focal length ([\d.]+) \+-", around) == pytest.approx(1000.0, rel=0.02)
    assert number(r"points: ([\d.]+)% of the scene", around) < 1
    assert "autocalibration: OK" not in sideways


def test_curves_alone(runner: Runner) -> None:
    text, _ = runner.run(EXAMPLES / "curves_alone.py")
    assert "projective: OK" in text
    assert "metric: OK" in text
    assert number(r"median distance ([\d.]+) px", text) < 0.05
    assert number(r"focal length: ([\d.]+) px", text) == pytest.approx(500.0, rel=0.02)
    assert number(r"at most ([\d.]+) degrees", text) < 0.5


def test_lines_and_curves(runner: Runner) -> None:
    text, _ = runner.run(EXAMPLES / "lines_and_curves.py")
    assert number(r"direction off by ([\d.]+) degrees", text) < 1
    assert number(r"centre off by ([\d.]+)", text) < 0.01
    assert number(r"curve: (\d+) of 60", text) > 50
    assert number(r"off by ([\d.]+) on average", text) < 1e-3
