"""The deployments that a service holds: the one in force, and the one that it was asked to have ready.

A run's deployments are numbered; the master counts them, and says its number when it greets (docs/operating.md, Reload).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Generic, TypeVar

from services.errors import NotPreparedError
from services.sockets.records import Hello, NotReloaded, Prepare, Prepared, Switch, Switched
from terminal.errors import exit_code_of
from toolchain.deployment import Deployment, load_deployment

Made = TypeVar("Made")


class Generations(Generic[Made]):
    """What a service works by, under the numbers of the run that it serves.

    Attributes:
        number: The generation in force.
    """

    def __init__(
        self, deployment: Deployment, make: Callable[[Deployment], Made], *, images: bool = False
    ) -> None:
        """Begin with a deployment.

        Args:
            deployment: The first one.
            make: Makes of a deployment what the service works with; its errors are those of preparing.
            images: Whether the service reads the boards' images too.
        """
        self.number = 0
        self._make = make
        self._images = images
        self._held: dict[int, tuple[Deployment, Made]] = {0: (deployment, make(deployment))}

    @property
    def deployment(self) -> Deployment:
        """The deployment in force."""
        return self._held[self.number][0]

    @property
    def made(self) -> Made:
        """What was made of it."""
        return self._held[self.number][1]

    def greeted(self, hello: Hello) -> None:
        """A master of this same deployment is there: it says the number."""
        self._held = {hello.generation: self._held[self.number]}
        self.number = hello.generation

    def prepare(self, record: Prepare) -> Prepared | NotReloaded:
        """Read and check a deployment, and keep it beside the one in force; gives the answer to the master."""
        try:
            loaded = load_deployment(Path(record.folder), images=self._images)
            made = self._make(loaded)
        except Exception as error:  # whatever else it is, the run goes on with what it has
            return NotReloaded(record.generation, exit_code_of(error), str(error))
        if loaded.hash != record.deployment_hash:
            return NotReloaded(
                record.generation,
                NotPreparedError.exit_code,
                f"{loaded.path} is deployment {loaded.hash[:12]} here and {record.deployment_hash[:12]} for the master; "
                "do both see the same folder? If it was changed just now, reload once more",
            )
        self._held = {self.number: self._held[self.number], record.generation: (loaded, made)}
        return Prepared(record.generation)

    def switch(self, record: Switch) -> Switched | NotReloaded:
        """Work by a deployment that is held; gives the answer to the master."""
        try:
            self.of(record.generation)
        except NotPreparedError as error:
            return NotReloaded(record.generation, error.exit_code, str(error))
        self.number = record.generation
        return Switched(record.generation)

    def of(self, number: int) -> tuple[Deployment, Made]:
        """What is held under a number.

        Raises:
            NotPreparedError: Nothing is.
        """
        try:
            return self._held[number]
        except KeyError:
            msg = f"generation {number} was not prepared here"
            raise NotPreparedError(msg) from None


@dataclass(slots=True)
class InForce:
    """The deployment that a run works by, as its master knows it; only a reload changes it.

    Attributes:
        deployment: The deployment.
        folder: Where it comes from, as the user named it.
        generation: How often the run has changed its deployment.
        former_hash: Of the deployment before it, which a service that starts meanwhile may still have read.
    """

    deployment: Deployment
    folder: Path
    generation: int = 0
    former_hash: str = ""

    def replace(self, deployment: Deployment, folder: Path) -> None:
        """Work by another one from now on."""
        self.former_hash = self.deployment.hash
        self.deployment, self.folder = deployment, folder
        self.generation += 1
