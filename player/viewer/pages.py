"""Pages of assets, served beside the viewer. A page is rendered by the visitor's own machine, so that this
one only has to send it.

A page is made once, when it is first asked for, and sent in small pieces as fast as each visitor takes them.
So it is in memory only once, however many ask. If it cannot be made, the next request tries again.
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
"""Most visitors that pages are sent to at the same time."""
PAGE_SECONDS = 900.0
"""Seconds within which a page must be made and taken: a slow visitor is not waited for without end."""
PIECE = 1 << 17
"""Bytes that are handed to a connection at a time."""


class Answer(NamedTuple):
    """A response to a visitor."""

    status: str
    """Status and reason, for example "200 OK"."""
    kind: str
    """Content-Type."""
    body: bytes


class Pages:
    """The pages of some assets: that of the first at PATH, those of the others at PATH/1, PATH/2, ..."""

    def __init__(self, makers: Sequence[Callable[[], bytes]]) -> None:
        """`makers`: functions, each of which makes the page of one asset, or raises VfrError if that is not
        possible."""
        self._makers = {page_path(index): maker for index, maker in enumerate(makers)}
        self._made: dict[str, asyncio.Future[bytes]] = {}
        self._downloads: set[asyncio.Task[Any]] = set()

    def close(self) -> None:
        """Cancel the downloads that are under way, because a server waits for them when it stops. May be
        called from any thread."""
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
            # shielded: the first visitor may leave, while the others still wait for it
            body = await asyncio.shield(self._made[path])
        except VfrError as error:
            return _refused(printable(str(error)))
        return Answer("200 OK", "text/html; charset=utf-8", body)

    async def _make(self, path: str) -> bytes:
        """Make a page. A failure is forgotten, so that the next request tries again: the asset may be whole
        by then."""
        try:
            return await asyncio.to_thread(self._makers[path])
        except BaseException:
            del self._made[path]
            raise


NO_PAGES = Pages(())


def page_path(index: int) -> str:
    """Return the path in the address of an asset's page, from the asset's index in the list of assets.

    >>> page_path(0), page_path(2)
    ('/page', '/page/2')
    """
    return f"{PATH}/{index}" if index else PATH


def _refused(why: str) -> Answer:
    return Answer("503 Service Unavailable", "text/plain; charset=utf-8", f"page: {why}\n".encode())


async def _send(connection: ServerConnection, answer: Answer) -> None:
    """Send an answer, as fast as the visitor takes it."""
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
