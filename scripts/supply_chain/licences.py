"""Check of the licences in a bill of materials against licences.toml (see scripts/bill-of-materials)."""

import json
import sys
import tomllib
from pathlib import Path
from typing import Any

from license_expression import get_spdx_licensing

SPDX = get_spdx_licensing()
RULES = tomllib.loads(Path(__file__).with_name("licences.toml").read_text(encoding="utf-8"))


def licence_of(component: dict[str, Any]) -> str:
    """Return a component's licence: from licences.toml if a person has looked it up, otherwise from its metadata."""
    stated = [
        each.get("expression")
        or each["license"].get("id")
        or f"not an SPDX identifier: {each['license']['name']}"
        for each in component.get("licenses", [])
    ]
    return RULES["read"].get(component["name"]) or " AND ".join(f"({each})" for each in stated) or "unknown"


def is_allowed(licence: str) -> bool:
    """Return whether an SPDX expression can be fulfilled with allowed licences alone."""
    if SPDX.validate(licence).errors:
        return False
    parsed = SPDX.parse(licence)
    # licences that are not allowed count as false, so an OR with an allowed side is true
    values = {each: SPDX.TRUE if str(each) in RULES["allowed"] else SPDX.FALSE for each in parsed.symbols}
    return bool(parsed.subs(values).simplify() == SPDX.TRUE)


def main() -> int:
    """Print every package with its licence; exit 1 if one is not allowed."""
    components = json.loads(Path(sys.argv[1]).read_text(encoding="utf-8"))["components"]
    refused = 0
    for each in components:
        licence = licence_of(each)
        print(f"{each['name']:24} {each['version']:12} {licence}")
        if not is_allowed(licence):
            refused += 1
            print(
                f"error: {each['name']} has the licence {licence}, which licences.toml does not allow",
                file=sys.stderr,
            )
    return 1 if refused else 0


if __name__ == "__main__":
    sys.exit(main())
