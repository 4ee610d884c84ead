"""Certificates for localhost, made by openssl."""

import subprocess
from pathlib import Path


def issue(folder: Path, name: str, *, ca: str | None = None) -> tuple[Path, Path]:
    """Make NAME.pem and its key NAME.key for localhost, signed by another certificate of the folder or by itself."""
    certificate, key = folder / f"{name}.pem", folder / f"{name}.key"
    command = "req -x509 -newkey ec -pkeyopt ec_paramgen_curve:P-256 -nodes -days 2"
    names = ("-subj", f"/CN={name}", "-addext", "subjectAltName=DNS:localhost,IP:127.0.0.1")
    signer = () if ca is None else ("-CA", str(folder / f"{ca}.pem"), "-CAkey", str(folder / f"{ca}.key"))
    openssl(*command.split(), *names, *signer, "-out", str(certificate), "-keyout", str(key))
    return certificate, key


def openssl(*words: str) -> None:
    subprocess.run(["openssl", *words], check=True, capture_output=True, timeout=240)
