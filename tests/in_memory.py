"""The application in memory: no socket, its lifespan running, one event loop."""

import asyncio
from collections.abc import Coroutine
from pathlib import Path
from types import TracebackType
from typing import Any

import httpx
import numpy as np
import orjson
from fastapi import FastAPI

from service.app import create_app
from service.settings import Settings

JSON = {"content-type": "application/json"}


def untimed(answer: bytes) -> bytes:
    """What of an answer in JSON is the same whenever it is asked for."""
    return answer[: answer.rindex(b',"timing_ms":')]


class Service(httpx.BaseTransport):
    """Also a transport for the service's own synchronous client."""

    def __init__(self, app: FastAPI) -> None:
        self.app = app
        self._runner = asyncio.Runner()
        self._lifespan = app.router.lifespan_context(app)
        self._transport = httpx.ASGITransport(app=app)
        self._http = httpx.AsyncClient(transport=self._transport, base_url="http://service")

    @classmethod
    def of(cls, bundles: Path, **settings: Any) -> "Service":
        return cls(create_app(Settings(bundles=bundles, threads=1, **settings)))

    def __enter__(self) -> "Service":
        self.run(self._lifespan.__aenter__())
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None = None,
        error: BaseException | None = None,
        traceback: TracebackType | None = None,
    ) -> None:
        self.run(self._lifespan.__aexit__(None, None, None))
        self.run(self._http.aclose())
        self._runner.close()

    def run(self, coroutine: Coroutine[Any, Any, Any]) -> Any:
        return self._runner.run(coroutine)

    def wait_until_loaded(self) -> None:
        async def loaded() -> None:
            while self.app.state.catalog.state == "loading":
                await asyncio.sleep(0)

        self.run(loaded())

    def get(self, path: str) -> httpx.Response:
        response: httpx.Response = self.run(self._http.get(path))
        return response

    def post(self, body: Any, path: str = "/predict") -> httpx.Response:
        """A response to fields, or to bytes as they are."""
        content = body if isinstance(body, bytes) else dumped(body)
        response: httpx.Response = self.run(self._http.post(path, content=content, headers=JSON))
        return response

    def post_together(self, bodies: list[Any]) -> list[httpx.Response]:
        async def gathered() -> list[httpx.Response]:
            posts = [self._http.post("/predict", content=dumped(b), headers=JSON) for b in bodies]
            return await asyncio.gather(*posts)

        responses: list[httpx.Response] = self.run(gathered())
        return responses

    def request(self, method: str, path: str, **options: Any) -> httpx.Response:
        response: httpx.Response = self.run(self._http.request(method, path, **options))
        return response

    def futures(self, poses: np.ndarray, **fields: Any) -> np.ndarray:
        """The futures of an answer that must be a good one, in float64."""
        response = self.post({"poses": poses, **fields})
        assert response.status_code == 200, response.text
        return np.array(orjson.loads(response.content)["futures"])

    def handle_request(self, request: httpx.Request) -> httpx.Response:
        async def handled() -> httpx.Response:
            response = await self._transport.handle_async_request(request)
            content = await response.aread()
            return httpx.Response(response.status_code, headers=response.headers, content=content)

        response: httpx.Response = self.run(handled())
        return response


def dumped(body: Any) -> bytes:
    return orjson.dumps(body, option=orjson.OPT_SERIALIZE_NUMPY)
