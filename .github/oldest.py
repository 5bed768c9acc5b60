"""The lowest versions that pyproject.toml allows, as a file of constraints for pip."""

import re
import tomllib
from pathlib import Path

project = tomllib.loads((Path(__file__).parent.parent / "pyproject.toml").read_text())["project"]
for requirement in [*project["dependencies"], *project["optional-dependencies"]["plot"]]:
    print(re.sub(r">=(.+)", r"==\1.*", requirement))
