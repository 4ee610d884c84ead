"""The newest posterior of a run, for the terminal of its master."""

import time

from posteriors.posterior import Posterior
from services.pipeline.inference import infer, report_of
from services.sockets.records import Publish
from toolchain.deployment import Deployment


def posterior_of(publish: Publish, deployment: Deployment) -> Posterior | None:
    """Return the posterior of a computed frame with its report, or None if all counts were 0."""
    inference = infer(publish.result, deployment)
    if inference.posterior is None:
        return None
    dimensions = deployment.result_dimensions
    # the result has not been sent to the robot yet, so the time of that stage is 0
    now = time.time_ns(), time.monotonic_ns()
    return Posterior(
        probabilities=tuple(inference.posterior.tolist()),
        labels=tuple(dimension.label for dimension in dimensions),
        sizes=tuple(dimension.size for dimension in dimensions),
        heard_ns=now[0],
        report=report_of(publish, inference, deployment, now=now, previous_out_ns=0),
    )
