"""A motion pushed through a live stream as if it happened now, and what is told of its answers."""

import asyncio
from collections.abc import AsyncIterator
from dataclasses import asdict

from models.motion.motion import Motion
from service.asking.exchange import BadRequestError
from service.asking.live import AsyncLive
from service.asking.messages import LivePrediction
from service.errors import TooFewFramesError
from service.media import JSON, encoded


async def replayed(
    motion: Motion, live: AsyncLive, *, speed: float
) -> AsyncIterator[LivePrediction | BadRequestError]:
    """Each answer, or why there is none, until that to the last frame; in real time at speed 1.

    Raises:
        TooFewFramesError: the motion is shorter than what has to be seen.
        ClientError: the stream cannot go on.
    """
    if (need_s := await live.ready()) > motion.duration:
        raise TooFewFramesError(
            pointer="/poses",
            found=f"{motion.duration:.2f} s in {motion.name}",
            expected=f"the model has to see {need_s:.2f} s",
        )
    playing = asyncio.ensure_future(_play(motion, live, speed=speed))
    answered_s, last_s = -1.0, (motion.num_frames - 1) / motion.fps
    try:
        while answered_s < last_s:
            try:
                answer = await anext(live)
            except BadRequestError as refused:
                if "t" not in refused.problem:
                    raise
                answered_s = refused.problem["t"]
                yield refused
            else:
                answered_s = answer.t
                yield answer
    finally:
        playing.cancel()
        await asyncio.gather(playing, return_exceptions=True)


def told(answer: LivePrediction | BadRequestError) -> str:
    """One line about an answer."""
    if isinstance(answer, BadRequestError):
        return f"{answer.problem['t']:8.3f} s: {answer}"
    prediction, steps = answer.prediction, answer.prediction.steps
    num_futures, num_frames = prediction.futures.shape[:2]
    milliseconds = sum(prediction.timing_ms.values())
    return (
        f"{answer.t:8.3f} s: {num_futures} futures of {num_frames / prediction.fps:.2f} s by "
        f"{prediction.model}, {steps.run} of {steps.of} steps, {milliseconds:.0f} ms"
    )


def recorded(answer: LivePrediction | BadRequestError) -> bytes:
    """The whole answer as a line of JSON."""
    if isinstance(answer, BadRequestError):
        content = {"t": answer.problem["t"], "problem": answer.problem}
    else:
        content = {"t": answer.t, **asdict(answer.prediction)}
    return encoded(content, JSON) + b"\n"


async def _play(motion: Motion, live: AsyncLive, *, speed: float) -> None:
    now = asyncio.get_running_loop().time
    started_s = now()
    for i, pose in enumerate(motion.positions):
        await asyncio.sleep(started_s + i / (motion.fps * speed) - now())
        live.push(pose, i / motion.fps)
