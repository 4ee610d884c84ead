"""The deployments of a service: the one in force, and the one prepared for a reload.

The master numbers the deployments of a run, and sends the current number in its hello
(docs/how-to/operating.md, Another deployment without stopping).
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
    """Deployments of a service by number, each with the data derived from it.

    Attributes:
        number: The generation in force.
    """

    def __init__(
        self, deployment: Deployment, derive: Callable[[Deployment], Derived], *, images: bool = False
    ) -> None:
        """Start with a deployment.

        `derive` returns the service's data for a deployment; if it raises an error, the deployment is
        refused. With `images`, the images of the boards are read too.
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
        """Use the number sent by a master with the same deployment."""
        self._held = {hello.generation: self._held[self.number]}
        self.number = hello.generation

    def prepare(self, record: Prepare) -> Prepared | NotReloaded:
        """Read, check and store a deployment besides the one in force, and return the answer for the master."""
        try:
            loaded = load_deployment(Path(record.folder), images=self._images)
            derived = self._derive(loaded)
        except Exception as error:  # even a bug must not end the run, which keeps its deployment
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
        """Put a prepared deployment into force, and return the answer for the master."""
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
    """The deployment in force in a run; only a reload changes it."""

    deployment: Deployment
    folder: Path
    """Its folder, as named by the user."""
    generation: int = 0
    """Number of reloads so far."""
    former_hash: str = ""
    """Hash of the previous deployment, which a service started during a reload may still have read."""

    def replace(self, deployment: Deployment, folder: Path) -> None:
        """Put another deployment into force."""
        self.former_hash = self.deployment.hash
        self.deployment, self.folder = deployment, folder
        self.generation += 1
