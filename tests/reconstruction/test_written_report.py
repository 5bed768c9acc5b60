"""The report shows every text as it is, whatever the files are called."""

import html
import json
import re
from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from small_model import make

from torchsfm.reconstruction import ImageReport, Report, SfmResult
from torchsfm.reconstruction.messages import describe_skipped, printable
from torchsfm.reconstruction.report import pair_report
from torchsfm.reconstruction.written_report import report_markdown, report_record

NAMES = ("a|b.jpg", "<img src=x onerror=alert(1)>.jpg", "[link](http:evil).jpg", "caf\udce9\n\x1b[31m.jpg")
SKIPPED = (("IMG|1.heic", "HEIC"), ("film <b>.mp4", "a video"))


def result(names: tuple[str, ...], skipped: tuple[tuple[str, str], ...] = ()) -> SfmResult:
    model = replace(make(), names=names)
    images = tuple(ImageReport(name, 0 if i < 3 else None, "" if i < 3 else name, 100) for i, name in enumerate(names))
    pairs = pair_report(torch.tensor([[0, 1]]), *(torch.tensor([50]),) * 3, torch.tensor([1]))
    return SfmResult((model,), Report(images, pairs, {"map": 1.0}, skipped=skipped))


def cells(line: str) -> list[str]:
    """The texts of a table's row as a reader of markdown sees them."""
    parts = re.split(r"(?<!\\)\|", line)[1:-1]
    return [html.unescape(re.sub(r"\\([!-/:-@\[-`{-~])", r"\1", part.strip())) for part in parts]


def shown(names: tuple[str, ...]) -> list[str]:
    page = report_markdown(report_record(result(names)))
    images = page.split("## Images")[1].split("## Pairs")[0].strip().splitlines()[2:]
    assert len(images) == len(names)
    rows = [cells(line) for line in images]
    assert {len(row) for row in rows} == {9}
    assert rows[3][-1] == printable(names[3]).strip()
    assert "<" not in page
    page.encode("utf-8")
    return [row[0] for row in rows]


def test_names_do_not_become_markup() -> None:
    assert shown(NAMES) == [printable(name) for name in NAMES]
    page = report_markdown(report_record(result(NAMES)))
    assert r"\[link\](http" in page
    assert "\x1b" not in page
    plain = ("view_0.png", "IMG 1 (2).jpg", "ä.jpg", "a-b.jpg")
    assert all(f"| {name} |" in report_markdown(report_record(result(plain))) for name in plain)


# All characters of UTF-8, as by default, but not found out by encoding each.
TEXT = st.text(st.characters(exclude_categories=["Cs"]), min_size=1)


@settings(deadline=None)
@given(st.lists(TEXT, min_size=4, max_size=4, unique=True))
def test_any_name_is_shown_as_it_is(names: list[str]) -> None:
    assert shown(tuple(names)) == [printable(name).strip() for name in names]


def test_what_was_passed_over_is_said() -> None:
    record = report_record(result(NAMES, SKIPPED))
    assert record["skipped"] == [{"name": name, "reason": reason} for name, reason in SKIPPED]
    assert json.loads(json.dumps(record)) == record
    page = report_markdown(record)
    assert r"| IMG\|1.heic | HEIC |" in page
    assert "| film &lt;b&gt;.mp4 | a video |" in page
    assert r"not read: IMG|1.heic (HEIC)" in result(NAMES, SKIPPED).report.summary()
    assert "Not read" not in report_markdown(report_record(result(NAMES)))


def test_many_names_are_counted() -> None:
    skipped = [(f"{i}.heic", "HEIC") for i in range(9)] + [("a", "a folder")]
    assert describe_skipped(skipped) == ["0.heic, 1.heic, 2.heic and 6 more (HEIC)", "a (a folder)"]


@pytest.mark.parametrize("name", NAMES)
def test_what_is_printed_fits_one_line(name: str) -> None:
    lines = result((*NAMES[:3], name)).report.summary().splitlines()
    (line,) = [line for line in lines if line.startswith("not registered")]
    assert line.isprintable()
    line.encode("utf-8")
