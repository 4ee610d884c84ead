"""docs/index.md: every page of the site's navigation is on it."""

import re
from pathlib import Path

ROOT = Path(__file__).parents[2]


def test_every_page_of_the_navigation_is_listed():
    pages = set(re.findall(r"^ +- [^:]+: (\S+\.md)$", (ROOT / "mkdocs.yml").read_text(), re.MULTILINE))
    listed = set(re.findall(r"\(([\w/-]+\.md)\)", (ROOT / "docs/index.md").read_text()))
    assert len(pages) > 20
    assert pages - {"index.md"} <= listed
