"""The page about machines: its examples give the shown results, and its table names every parameter."""

import dataclasses
import doctest
from pathlib import Path

from machines.parameters import BM1Parameters

PAGE = Path(__file__).parents[2] / "docs/reference/machines.md"


def test_examples():
    # Fences would be taken for output.
    text = PAGE.read_text(encoding="utf-8").replace("```python\n", "\n").replace("```\n", "\n")
    test = doctest.DocTestParser().get_doctest(text, {}, "machines.md", str(PAGE), 0)
    assert len(test.examples) > 8
    report = []
    doctest.DocTestRunner(verbose=False).run(test, out=report.append)
    assert not report, "".join(report)


def test_every_parameter_is_described():
    page = PAGE.read_text(encoding="utf-8")
    for field in dataclasses.fields(BM1Parameters):
        default = "" if field.default is dataclasses.MISSING else f" {field.default}"
        if isinstance(field.default, str):
            default = f" `{field.default}`"
        elif isinstance(field.default, bool):
            default = f" {str(field.default).lower()}"
        elif field.name == "steps_per_clock":
            default = " by kind"
        assert f"| `{field.name}` |{default} |" in page
