"""The handler of an action that the tests serve."""

from typing import Any

from bridge.client import GoalRequest

FIBONACCI = "actionlib_tutorials/Fibonacci"


async def count(goal: GoalRequest) -> dict[str, Any] | None:
    """Count to the order of the goal, and end it in the way that its order says."""
    order = goal.values["order"]
    goal.feed_back({"sequence": [0, 1]})
    if order == 1:
        goal.abort({"sequence": [1]})
        return None
    if order == 2:
        await goal.wait_canceling()
        return {"sequence": [2]}
    if order == 3:
        raise RuntimeError("a bug")
    return {"sequence": list(range(order))}
