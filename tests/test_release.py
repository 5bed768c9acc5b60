"""What stands beside the package for a release says the same as pyproject.toml."""

import re
import runpy
import subprocess
import sys
import tomllib
from importlib import metadata
from pathlib import Path
from typing import Any

import pytest

import torchsfm

ROOT = Path(__file__).parent.parent
PYPROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
PROJECT = PYPROJECT["project"]
PYTHONS = [line.rpartition(" ")[2] for line in PROJECT["classifiers"] if re.search(r"Python :: \d\.\d+$", line)]


def test_the_package_says_its_version() -> None:
    assert torchsfm.__version__ == metadata.version("torchsfm")
    assert re.fullmatch(r"\d+\.\d+\.\d+", PROJECT["version"])


def test_the_citation_is_of_this_version() -> None:
    said = re.search(r"^version: (.+)$", (ROOT / ".github" / "CITATION.cff").read_text(), re.MULTILINE)
    assert said is not None
    assert said[1] == PROJECT["version"]


def test_the_changelog_has_no_later_version() -> None:
    versions = re.findall(r"^## \[(\d+\.\d+\.\d+)\]", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    numbers = [tuple(map(int, version.split("."))) for version in [PROJECT["version"], *versions]]
    assert numbers == sorted(numbers, reverse=True)


def test_oldest_versions_are_those_that_are_allowed(capsys: pytest.CaptureFixture[str]) -> None:
    runpy.run_path(str(ROOT / ".github" / "oldest.py"))
    pins = dict(line.split("==") for line in capsys.readouterr().out.splitlines())
    for requirement in PROJECT["dependencies"]:
        name, version = requirement.split(">=")
        assert pins[name] == f"{version}.*"


def test_workflows_run_on_every_python_that_is_promised() -> None:
    yaml = pytest.importorskip("yaml")
    flows = {path.stem: yaml.safe_load(path.read_text()) for path in (ROOT / ".github" / "workflows").glob("*.yml")}
    assert set(flows) == {"tests", "release"}
    jobs = flows["tests"]["jobs"]
    assert jobs["tests"]["strategy"]["matrix"]["python"] == PYTHONS
    assert PROJECT["requires-python"] == f">={PYTHONS[0]}"
    for flow in flows.values():
        assert flow["permissions"] == {"contents": "read"}
        for job in flow["jobs"].values():
            assert job["timeout-minutes"] <= 60
            for step in job["steps"]:
                for extra in re.findall(r"\.\[([\w,]+)\]", step.get("run", "")):
                    assert set(extra.split(",")) <= set(PROJECT["optional-dependencies"])
    for path in (ROOT / ".github" / "ISSUE_TEMPLATE").glob("*.yml"):
        yaml.safe_load(path.read_text())


def test_the_conda_recipe_has_the_same_dependencies() -> None:
    jinja2 = pytest.importorskip("jinja2")
    yaml = pytest.importorskip("yaml")

    def load(path: str, from_recipe_dir: bool) -> dict[str, Any]:
        assert from_recipe_dir
        return tomllib.loads((ROOT / ".conda" / path).read_text())

    recipe = (ROOT / ".conda" / "meta.yaml").read_text()
    shown = yaml.safe_load(jinja2.Template(recipe).render(load_file_data=load, PYTHON="python"))
    assert shown["package"] == {"name": "torchsfm", "version": PROJECT["version"]}
    python, *rest = shown["requirements"]["run"]
    assert python == "python " + PROJECT["requires-python"]
    renamed = {"torch": "pytorch", "opencv-python-headless": "py-opencv"}
    wanted = (requirement.split(">=") for requirement in PROJECT["dependencies"])
    assert rest == [f"{renamed.get(name, name)} >={version}" for name, version in wanted]
    assert shown["build"]["entry_points"] == [f"{name} = {place}" for name, place in PROJECT["scripts"].items()]
    assert PYPROJECT["build-system"]["requires"][0].replace(">", " >") in shown["requirements"]["host"]


@pytest.mark.parametrize("script", ["run", "release"])
def test_scripts_are_read_by_the_shell(script: str) -> None:
    if sys.platform == "win32":
        pytest.skip("no bash")
    subprocess.run(["bash", "-n", str(ROOT / ".ci" / script)], check=True)
