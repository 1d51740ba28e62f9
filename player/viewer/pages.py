"""The page of an asset beside the viewer. The visitor's own machine draws it, so that this one has nothing to
do but to send it.

A page is made when it is first asked for, once, and sent in small pieces as fast as each visitor takes them,
so that it is in memory once, whoever asks. One that cannot be made is tried again when it is next asked for.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

from player.errors import VfrError
from player.terminal import printable

if TYPE_CHECKING:
    from websockets.asyncio.server import ServerConnection

PATH = "/page"
MOST_DOWNLOADS = 32
"""Visitors who are sent a page at a time."""
PAGE_SECONDS = 900.0
"""Time in which a page has to be made and taken; a slow visitor is not waited for without end."""
PIECE = 1 << 17
"""Bytes that are handed over at a time."""


class Answer(NamedTuple):
    """What a visitor is sent."""

    status: str
    """Status and reason, for example "200 OK"."""
    kind: str
    """Content-Type."""
    body: bytes


class Pages:
    """The pages of some assets: that of the first at PATH, those of the others at PATH/1, PATH/2, ..."""

    def __init__(self, makers: Sequence[Callable[[], bytes]]) -> None:
        """`makers`: each makes the page of one asset, or raises VfrError where that has none."""
        self._makers = {page_path(index): maker for index, maker in enumerate(makers)}
        self._made: dict[str, asyncio.Future[bytes]] = {}
        self._downloads: set[asyncio.Task[Any]] = set()

    def close(self) -> None:
        """End the downloads that are under way, from any thread: a server waits for them when it stops."""
        for task in list(self._downloads):
            task.get_loop().call_soon_threadsafe(task.cancel)

    def __contains__(self, path: str) -> bool:
        return path.partition("?")[0] in self._makers

    async def send(self, connection: ServerConnection, path: str) -> None:
        """Answer a request for one of the pages, and wait until the visitor has it or is gone."""
        task = asyncio.current_task()
        assert task is not None
        if len(self._downloads) >= MOST_DOWNLOADS:
            return await _send(
                connection, _refused(f"at most {MOST_DOWNLOADS} visitors at a time: try again")
            )
        self._downloads.add(task)
        try:
            await _send(connection, await self._answer(path.partition("?")[0]))
        finally:
            self._downloads.discard(task)

    async def _answer(self, path: str) -> Answer:
        if path not in self._made:
            self._made[path] = asyncio.ensure_future(self._make(path))
        try:
            # whoever asked first may go: the others still wait for it
            body = await asyncio.shield(self._made[path])
        except VfrError as error:
            return _refused(printable(str(error)))
        return Answer("200 OK", "text/html; charset=utf-8", body)

    async def _make(self, path: str) -> bytes:
        """Make a page. One that cannot be made is forgotten, so that whoever asks next has it tried again: an
        asset may be whole by then."""
        try:
            return await asyncio.to_thread(self._makers[path])
        except BaseException:
            del self._made[path]
            raise


NO_PAGES = Pages(())


def page_path(index: int) -> str:
    """Where the page of an asset is, by its place in the list of assets.

    >>> page_path(0), page_path(2)
    ('/page', '/page/2')
    """
    return f"{PATH}/{index}" if index else PATH


def _refused(why: str) -> Answer:
    return Answer("503 Service Unavailable", "text/plain; charset=utf-8", f"page: {why}\n".encode())


async def _send(connection: ServerConnection, answer: Answer) -> None:
    """Send an answer, no more of it at a time than the visitor takes."""
    lines = [
        f"HTTP/1.1 {answer.status}",
        f"Content-Type: {answer.kind}",
        f"Content-Length: {len(answer.body)}",
        "Cache-Control: no-cache",
        "X-Content-Type-Options: nosniff",
        "Connection: close",
    ]
    connection.transport.write("\r\n".join([*lines, "", ""]).encode())
    body = memoryview(answer.body)
    for begin in range(0, len(body), PIECE):
        if connection.transport.is_closing():
            return
        connection.transport.write(body[begin : begin + PIECE])
        await connection.drain()
    if connection.transport.can_write_eof():
        connection.transport.write_eof()
    await asyncio.shield(
        connection.connection_lost_waiter
    )  # what is on its way arrives before this end closes
