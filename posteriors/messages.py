"""ROS messages of the result topics as pydantic models: what both topics share."""

from typing import Any, TypeVar

from pydantic import BaseModel, ConfigDict, TypeAdapter, ValidationError

from posteriors.errors import BadResultError

Model = TypeVar("Model")


class Part(BaseModel):
    """A part of a ROS message; fields that are not named here are ignored."""

    model_config = ConfigDict(extra="ignore", frozen=True)


def validated(adapter: TypeAdapter[Model], value: object, topic: str, type_name: str) -> Model:
    """Return a message, or a part of it, as its model.

    Raises:
        BadResultError: It does not fit; the sentence names the topic, the type, and the first place that is wrong.
    """
    try:
        return adapter.validate_python(value)
    except ValidationError as error:
        first: Any = error.errors(include_url=False)[0]
        place = ".".join(str(step) for step in first["loc"]) or "the message"
        reason = f"{place}: {first['msg'][:1].lower()}{first['msg'][1:]}"
        raise BadResultError(
            f"a message on {topic} is not the {type_name} that the master publishes ({reason})"
        ) from None
