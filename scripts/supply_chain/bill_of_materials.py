"""Bill of materials: every package of the lock files with version, hashes and licence, as CycloneDX 1.6."""

from __future__ import annotations

import re
import sys
import tomllib
import uuid
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, metadata
from pathlib import Path
from typing import Final

from cyclonedx.exception import CycloneDxException
from cyclonedx.model import HashAlgorithm, HashType
from cyclonedx.model.bom import Bom, BomMetaData
from cyclonedx.model.component import Component, ComponentScope, ComponentType
from cyclonedx.model.license import LicenseExpression
from cyclonedx.output.json import JsonV1Dot6
from license_expression import get_spdx_licensing
from packageurl import PackageURL

from scripts.running.flags import ScriptParser, output_file

ROOT: Final = Path(__file__).resolve().parents[2]
LICENCES: Final = Path(__file__).with_name("licences.toml")
_PINNED: Final = re.compile(r"^([A-Za-z0-9._-]+)==([^\s;\\]+)")
_HASH: Final = re.compile(r"--hash=sha256:([0-9a-f]{64})")
_NAMESPACE: Final = uuid.UUID("6ba7b811-9dad-11d1-80b4-00c04fd430c8")


class LicenceError(Exception):
    """A package whose licence is unknown, or does not allow its use here."""


@dataclass(frozen=True, slots=True)
class Package:
    """A pinned package of a lock file."""

    name: str
    version: str
    hashes: tuple[str, ...]


def locked(path: Path) -> list[Package]:
    """Return the packages of a lock file, in its order."""
    return [
        Package(pinned[1], pinned[2], tuple(_HASH.findall(entry)))
        for entry in re.split(r"\n(?=\S)", path.read_text(encoding="utf-8"))
        if (pinned := _PINNED.match(entry)) is not None
    ]


def licence_of(package: Package, known: dict[str, str]) -> str:
    """Return a package's licence as an SPDX expression: the package's, or `known`, which a person checked.

    Raises:
        LicenceError: Neither has it, or both and they differ.
    """
    try:
        own = metadata(package.name).json.get("license_expression")
    except PackageNotFoundError:
        own = None
    stated = own if isinstance(own, str) else None
    read = known.get(package.name)
    if stated and read:
        raise LicenceError(
            f"{package.name} {package.version} states its licence by now ({stated}): remove it from {LICENCES.name}"
        )
    if not stated and not read:
        raise LicenceError(
            f"{package.name} {package.version} does not state its licence as an SPDX expression: read it, and add it to {LICENCES.name}"
        )
    return stated or str(read)


def check(package: Package, licence: str, allowed: set[str]) -> None:
    """Check that a licence allows a package to be shipped with this project.

    Raises:
        LicenceError: No choice of the expression's licences is allowed.
    """
    spdx = get_spdx_licensing()
    parsed = spdx.parse(licence, validate=True)
    unknown = {str(each) for each in spdx.license_symbols(parsed, decompose=False)} - allowed
    # licences that are not allowed count as false, so an OR with an allowed side is true
    values = {each: spdx.TRUE if str(each) in allowed else spdx.FALSE for each in parsed.symbols}
    if parsed.subs(values).simplify() != spdx.TRUE:
        raise LicenceError(
            f"{package.name} {package.version} has the licence {licence}; {', '.join(sorted(unknown))} is not among those allowed in {LICENCES.name}"
        )


def bill(lock: Path, dev_lock: Path) -> Bom:
    """Return the bill: packages that users install are required, packages only for tests are excluded.

    Raises:
        LicenceError: A required package's licence is unknown, or not allowed.
    """
    rules = tomllib.loads(LICENCES.read_text(encoding="utf-8"))
    allowed, known = set(rules["allowed"]), dict(rules["read"])
    required = locked(lock)
    names = {package.name for package in required}
    components = []
    for package in [*required, *(each for each in locked(dev_lock) if each.name not in names)]:
        licences = []
        if package.name in names:
            licence = licence_of(package, known)
            check(package, licence, allowed)
            licences = [LicenseExpression(licence)]
        components.append(
            Component(
                name=package.name,
                version=package.version,
                type=ComponentType.LIBRARY,
                scope=ComponentScope.REQUIRED if package.name in names else ComponentScope.EXCLUDED,
                bom_ref=f"{package.name}=={package.version}",
                hashes=[HashType(alg=HashAlgorithm.SHA_256, content=each) for each in package.hashes],
                licenses=licences,
                purl=PackageURL("pypi", None, package.name, package.version),
            )
        )
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    own = Component(
        name=project["name"],
        version=project["version"],
        type=ComponentType.APPLICATION,
        bom_ref=project["name"],
        licenses=[LicenseExpression(project["license"])],
    )
    # so that the same lock files always give the same bill
    serial = uuid.uuid5(_NAMESPACE, lock.read_text() + dev_lock.read_text())
    whole = Bom(components=components, metadata=BomMetaData(component=own), serial_number=serial)
    direct = {re.split(r"[\[<>=;~! ]", each, maxsplit=1)[0] for each in project["dependencies"]}
    whole.register_dependency(own, [each for each in components if each.name in direct])
    return whole


def main() -> int:
    """Write the bill."""
    parser = ScriptParser(prog="scripts/bill-of-materials", description=__doc__)
    parser.add_argument(
        "--json", type=output_file, metavar="FILE", default=ROOT / "out" / "rosbayes.cdx.json"
    )
    file: Path = parser.parse_args().json
    try:
        whole = bill(ROOT / "requirements.lock", ROOT / "requirements-dev.lock")
    except (LicenceError, CycloneDxException) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(JsonV1Dot6(whole).output_as_string(indent=2) + "\n", encoding="utf-8")
    for component in sorted(whole.components, key=lambda each: each.name):
        if component.scope is ComponentScope.REQUIRED:
            licence = ", ".join(
                each.value for each in component.licenses if isinstance(each, LicenseExpression)
            )
            print(f"{component.name:24} {component.version:12} {licence}")
    print(f"{len(whole.components)} packages: {file}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
