"""The line protocol's door: places, the word, and addresses that try words; the lines themselves in test_live.py."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import socket
from collections.abc import AsyncIterator, Awaitable, Callable

import pytest

from stereorig.server.config.rig_file import LiveSection
from stereorig.server.http import line_protocol
from stereorig.server.http.line_protocol import LineServer
from stereorig.server.http.shutout import ShutOut

WORD = "a-long-word"


class NoRuns:
    """Live measurements, of which there is none."""

    current = None


class Link:
    """A client's connection."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.reader, self.writer = reader, writer

    def send(self, *lines: str) -> None:
        """Send lines."""
        self.writer.write("".join(f"{line}\n" for line in lines).encode())

    async def line(self) -> str:
        """Return the next line; empty at the end."""
        return (await asyncio.wait_for(self.reader.readline(), 20.0)).decode().strip()

    async def works(self) -> bool:
        """Return True if queries are answered."""
        self.send("*IDN?")
        return (await self.line()).startswith("stereorig,live,none")


@contextlib.asynccontextmanager
async def opened(word: str | None = WORD) -> AsyncIterator[tuple[LineServer, Callable[..., Awaitable[Link]]]]:
    section = LiveSection(tcp_port=0, tcp_token=word)
    server = LineServer(section, NoRuns(), ShutOut())  # type: ignore[arg-type]
    await server.start()
    links = []

    async def dial(address: str = "127.0.0.1", *lines: str) -> Link:
        link = Link(*await asyncio.open_connection("127.0.0.1", server.port, local_addr=(address, 0)))
        links.append(link)
        link.send(*lines)
        return link

    try:
        yield server, dial
    finally:
        for link in links:
            link.writer.close()
        await server.close()


def run(scenario: Callable[[], Awaitable[None]]) -> None:
    asyncio.run(asyncio.wait_for(scenario(), 60.0))  # type: ignore[arg-type]


def test_the_word_is_due_within_its_time(monkeypatch: pytest.MonkeyPatch) -> None:
    assert line_protocol.WORD_S == 10.0
    monkeypatch.setattr(line_protocol, "WORD_S", 0.5)

    async def scenario() -> None:
        async with opened() as (_, dial):
            late, trickling = await dial(), await dial("127.0.0.1", "*CLS")
            right = await dial("127.0.0.1", f"SYST:PASS {WORD}")
            trickling.writer.write(b"SYST:PA")
            for link in (late, trickling):
                assert "the word was due" in await link.line()
                assert not await link.line()
            assert await right.works()

    run(scenario)


def test_three_errors_before_the_word_end_the_connection_and_later_ones_do_not() -> None:
    async def scenario() -> None:
        async with opened() as (_, dial):
            link = await dial("127.0.0.1", "READ:ALL?", "READ:ALL?", "SYST:ERR?", "READ:ALL?", "SYST:ERR?")
            assert (await link.line()).startswith("-203,")
            assert "3 errors before the word" in await link.line()
            assert not await link.line()
            right = await dial("127.0.0.1", f"SYST:PASS {WORD}", *["NO:SUCH?"] * 30)
            assert await right.works()

    run(scenario)


@pytest.mark.fault(60)
def test_wrong_words_cost_a_second_each_and_ten_shut_the_address_out(monkeypatch: pytest.MonkeyPatch) -> None:
    assert line_protocol._DELAY_S == 1.0
    monkeypatch.setattr(line_protocol, "_DELAY_S", 0.2)

    async def scenario() -> None:
        async with opened() as (_, dial):
            loop = asyncio.get_running_loop()
            began = loop.time()
            link = await dial("127.0.0.1", "SYST:PASS wrong-word", f"SYST:PASS {WORD}")
            assert await link.works()
            assert loop.time() - began >= 0.2
            for _ in range(3):
                guesses = await dial("127.0.0.1", *["SYST:PASS wrong-word"] * 3)
                assert "before the word" in await guesses.line()
            refused = await dial("127.0.0.1", f"SYST:PASS {WORD}")
            assert "shut out for 60 s" in await refused.line()
            assert not await refused.line()
            assert await (await dial("127.0.0.2", f"SYST:PASS {WORD}")).works()
            assert await link.works()  # who gave the word before keeps the connection

    run(scenario)


def test_a_place_is_kept_for_the_address_that_gave_the_word_last(caplog: pytest.LogCaptureFixture) -> None:
    async def scenario() -> None:
        async with opened() as (_, dial):
            machine = await dial("127.0.0.9", f"SYST:PASS {WORD}")
            assert await machine.works()
            option = machine.writer.get_extra_info("socket").getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY)
            assert option
            machine.writer.close()
            silent = [await dial(f"127.0.0.{2 + n // 8}") for n in range(32)]
            ninth = await dial("127.0.0.2")
            assert "8 connections of 127.0.0.2 are open" in await ninth.line()
            assert "32 places are taken" in await silent[-1].line()
            again = await dial("127.0.0.9", f"SYST:PASS {WORD}")
            assert await again.works()

    with caplog.at_level(logging.WARNING, logger="stereorig.lines"):
        run(scenario)
    assert len(caplog.records) == 1  # a line a minute, whatever comes


def test_without_a_word_places_are_kept_for_an_hour() -> None:
    async def scenario() -> None:
        async with opened(None) as (server, dial):
            link = await dial("127.0.0.1", *["NO:SUCH?"] * 30)
            assert await link.works()
            assert server.port

    run(scenario)
