"""Base class and validation of the pydantic models for ROS messages on the result topics."""

from typing import Any, TypeVar

from pydantic import BaseModel, ConfigDict, TypeAdapter, ValidationError

from posteriors.errors import BadResultError

Model = TypeVar("Model")


class Part(BaseModel):
    """A ROS message or a part of a message. Undeclared fields are ignored."""

    model_config = ConfigDict(extra="ignore", frozen=True)


def validated(adapter: TypeAdapter[Model], value: object, topic: str, type_name: str) -> Model:
    """Return a message, or a part of a message, as its model.

    Raises:
        BadResultError: The value does not fit the model. The error names the topic, the type, and the first mistake.
    """
    try:
        return adapter.validate_python(value)
    except ValidationError as error:
        first: Any = error.errors(include_url=False)[0]
        place = ".".join(str(step) for step in first["loc"]) or "the message"
        reason = f"{place}: {first['msg'][:1].lower()}{first['msg'][1:]}"
        raise BadResultError(f"a message on {topic} is not the expected {type_name} ({reason})") from None
