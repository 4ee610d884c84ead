"""A listener, which receives, shows and saves the posteriors of a stack."""

from typing import Final

from bridge.client import connect
from posteriors.axes import Axis
from posteriors.errors import BadResultError, LabelError, NoResultError
from posteriors.listening import posteriors
from posteriors.posterior import MAX_RESULT, Posterior
from services.errors import SettingsError
from services.output.posterior_file import ResultFile
from services.output.posterior_output import Show
from services.settings import Settings
from terminal.connection import report_connection
from terminal.output import say, warn
from toolchain.deployment import Deployment

_QUEUE_SIZE: Final = 1024
"""Maximum number of frames that wait for a slow terminal or disk."""


async def show_frames(
    settings: Settings,
    deployment: Deployment | None,
    *,
    uri: str,
    topic: str,
    count: int | None,
    silence: float | None,
    show: Show,
    file: ResultFile | None,
) -> int:
    """Show and save frames until `count` posteriors have arrived. If `count` is None, continue without end.

    After the first frame, at most `silence` seconds may pass between two frames. None means no limit.

    Raises:
        NoResultError: No frame arrived in time.
        BadResultError: The first message is not a result of a master.
        SettingsError: The posterior does not fit the deployment, or the file cannot be written.
        BridgeError: The server is unreachable, or is not a rosbridge server.
    """
    taken = 0
    # Before the first frame, silence and a strange message mean a wrong topic, and end the command. Afterwards the
    # stack may come back: without --timeout, each silence is reported once.
    began = False
    silence_reported = False
    limit: float = settings.first_data_timeout
    async with (
        connect(
            uri,
            connect_timeout=settings.connect_timeout,
            retry=True,
            ca_file=settings.ca,
            ros_version=settings.ros_version,
            on_state=report_connection(uri),
            # posteriors of fine grids are larger than other messages
            max_size=MAX_RESULT,
        ) as ros,
        posteriors(
            ros, topic=topic, deployment=deployment.name if deployment else None, queue_size=_QUEUE_SIZE
        ) as frames,
    ):
        say(f"listening on {topic} at {uri}")
        try:
            while count is None or taken < count:
                try:
                    one = await frames.next_frame(silence if began and silence else limit)
                except NoResultError as error:
                    if not began or silence:
                        raise
                    if not silence_reported:
                        warn(str(error))
                    silence_reported = True
                    continue
                except BadResultError as error:
                    if not began:
                        raise
                    warn(str(error))
                    continue
                began, silence_reported = True, False
                axes: list[Axis] = []
                # a frame without a posterior is shown, but does not count
                if isinstance(one, Posterior):
                    taken += 1
                    try:
                        axes = (one if deployment is None else one.with_units(deployment)).axes
                    except LabelError as error:
                        raise SettingsError(str(error)) from error
                # saved first: the reader of standard output may end this command
                if file is not None:
                    file.add(one, axes)
                show(one, axes)
        finally:
            if frames.lost:
                warn(f"{frames.lost} were lost: they arrived faster than they could be shown or saved")
    return 0
