"""An engine that several threads step."""

from collections.abc import Sequence
from threading import Thread

from service.engine.engine import Engine
from service.engine.trajectory import Failure, Preview, Request, Result


def run_by_threads(
    engine: Engine, requests: Sequence[Request], *, threads: int
) -> list[list[Result | Failure | Preview]]:
    """What became of each request."""
    events: dict[int, list[Result | Failure | Preview]] = {engine.add(r): [] for r in requests}

    def drive() -> None:
        while engine.num_requests:
            for event in engine.turn(shares=threads).events:
                events[event.request_id].append(event)

    drivers = [Thread(target=drive) for _ in range(threads)]
    for driver in drivers:
        driver.start()
    for driver in drivers:
        driver.join()
    return list(events.values())
