"""The setting `integrity`: detection of silently wrong counts of boards."""

from dataclasses import dataclass
from typing import Final

from machines.parameters import RngReset
from services.errors import SettingsError
from services.settings import Settings
from toolchain.deployment import Deployment
from toolchain.deployment.sections import Integrity

LEAST_TARGET: Final = 100
"""Minimum target count with which two computations of a frame can be compared by equation 2.1."""


@dataclass(frozen=True, slots=True)
class IntegrityRule:
    """The rule in force: the kind of detection, and the frames within which canaries find a flipped bit."""

    kind: Integrity
    frames: int


def integrity_rule(settings: Settings, deployment: Deployment) -> IntegrityRule:
    """Return the rule of a run: the flag or variable, or else that of the deployment.

    Raises:
        SettingsError: The rule is unsound with the machine of this deployment.
    """
    kind = Integrity(settings.integrity or deployment.integrity)
    machine = deployment.machine
    is_free = machine.rng_reset is RngReset.FREE
    if kind is Integrity.CANARY and is_free:
        raise SettingsError(
            "integrity = canary needs rng_reset = bank: with free generators, the counts of a known reading depend on "
            "all frames before it; use integrity = twice or off"
        )
    if kind is Integrity.TWICE and machine.rng_banks < 2 and not is_free:
        raise SettingsError(
            "integrity = twice needs two banks, and this machine has one (rng_banks); build it with more, or use "
            "integrity = canary"
        )
    if kind is Integrity.TWICE and machine.target_count < LEAST_TARGET:
        raise SettingsError(
            f"integrity = twice needs a target count of {LEAST_TARGET} or more, and this one is {machine.target_count}: "
            "lower counts differ too much by chance; use integrity = canary"
        )
    return IntegrityRule(kind, settings.integrity_frames or deployment.integrity_frames)
