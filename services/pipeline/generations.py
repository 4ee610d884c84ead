"""The deployments that a service holds: the one in force, and the one that is prepared for a reload.

The master numbers a run's deployments, and sends the current number in its greeting (docs/how-to/operating.md, Another deployment without stopping).
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Generic, TypeVar

from services.errors import NotPreparedError
from services.sockets.records import Hello, NotReloaded, Prepare, Prepared, Switch, Switched
from terminal.errors import exit_code_of
from toolchain.deployment import Deployment, load_deployment

Derived = TypeVar("Derived")


class Generations(Generic[Derived]):
    """A service's deployments by number, each with the data that the service derives from it.

    Attributes:
        number: The generation in force.
    """

    def __init__(
        self, deployment: Deployment, derive: Callable[[Deployment], Derived], *, images: bool = False
    ) -> None:
        """Begin with a deployment.

        `derive` returns the service's data for a deployment; an error of it refuses the deployment. With `images` the boards'
        images are read too.
        """
        self.number = 0
        self._derive = derive
        self._images = images
        self._held: dict[int, tuple[Deployment, Derived]] = {0: (deployment, derive(deployment))}

    @property
    def deployment(self) -> Deployment:
        """Deployment in force."""
        return self._held[self.number][0]

    @property
    def derived(self) -> Derived:
        """Data derived from it."""
        return self._held[self.number][1]

    def adopt(self, hello: Hello) -> None:
        """Take over the number that a master of the same deployment has sent."""
        self._held = {hello.generation: self._held[self.number]}
        self.number = hello.generation

    def prepare(self, record: Prepare) -> Prepared | NotReloaded:
        """Read and check a deployment, keep it beside the one in force, and return the answer for the master."""
        try:
            loaded = load_deployment(Path(record.folder), images=self._images)
            derived = self._derive(loaded)
        except Exception as error:  # even a bug must not end the run, which goes on with what it has
            return NotReloaded(record.generation, exit_code_of(error), str(error))
        if loaded.hash != record.deployment_hash:
            return NotReloaded(
                record.generation,
                NotPreparedError.exit_code,
                f"{loaded.path} is deployment {loaded.hash[:12]} here and {record.deployment_hash[:12]} for the master; "
                "do both see the same folder? If it was changed just now, reload once more",
            )
        self._held = {self.number: self._held[self.number], record.generation: (loaded, derived)}
        return Prepared(record.generation)

    def switch(self, record: Switch) -> Switched | NotReloaded:
        """Put a held deployment into force, and return the answer for the master."""
        try:
            self.get(record.generation)
        except NotPreparedError as error:
            return NotReloaded(record.generation, error.exit_code, str(error))
        self.number = record.generation
        return Switched(record.generation)

    def get(self, number: int) -> tuple[Deployment, Derived]:
        """Return the deployment with a number, and the data derived from it, or raise a NotPreparedError."""
        try:
            return self._held[number]
        except KeyError:
            raise NotPreparedError(f"generation {number} was not prepared here") from None


@dataclass(slots=True)
class InForce:
    """A run's deployment in force, as the master knows it; only a reload changes it."""

    deployment: Deployment
    folder: Path
    """Its folder, as the user named it."""
    generation: int = 0
    """Number of reloads so far."""
    former_hash: str = ""
    """Hash of the deployment before it, which a service that starts during a reload may still have read."""

    def replace(self, deployment: Deployment, folder: Path) -> None:
        """Put another deployment into force."""
        self.former_hash = self.deployment.hash
        self.deployment, self.folder = deployment, folder
        self.generation += 1
