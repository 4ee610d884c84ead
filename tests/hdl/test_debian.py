"""Installing what a verification needs: one sentence where that cannot be done."""

import pytest

from scripts.verifications import debian


def only(found):
    return lambda program: f"/usr/bin/{program}" if program in found else None


def test_nothing_is_installed_where_nothing_is_missing(monkeypatch):
    monkeypatch.setattr(debian.shutil, "which", only({"ghdl"}))
    monkeypatch.setattr(debian.subprocess, "run", lambda *_, **__: pytest.fail("something was installed"))
    debian.install({"ghdl": "ghdl"})


def test_the_error_on_another_system_names_what_to_install(monkeypatch):
    monkeypatch.setattr(debian.shutil, "which", only(set()))
    with pytest.raises(
        debian.MissingToolError, match=r"^srec_cat and tclsh not found; install srecord tcl \(Debian"
    ):
        debian.install({"srec_cat": "srecord", "tclsh": "tcl"})


def test_debian_installs_what_is_missing(monkeypatch):
    found, said = {"apt-get", "tclsh"}, []

    def run(command, **_):
        said.append(command)
        if "install" in command:
            found.add("srec_cat")

    monkeypatch.setattr(debian.shutil, "which", only(found))
    monkeypatch.setattr(debian.os, "geteuid", lambda: 0)
    monkeypatch.setattr(debian.subprocess, "run", run)
    debian.install({"srec_cat": "srecord", "tclsh": "tcl"})
    assert [command[:2] for command in said] == [["apt-get", "update"], ["apt-get", "install"]]
    assert said[1][-1] == "srecord"
