"""A port whose other end is a function of the test."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from serial.serialutil import SerialException

from station.device.port import Port


class Scripted:
    """A pyserial-like line: what is written goes to ``answer``, which returns what comes back."""

    def __init__(self, answer: Callable[[bytes], bytes]) -> None:
        self._answer, self._bytes = answer, b""
        self.written = b""
        self.gone = False

    def _check(self) -> None:
        if self.gone:
            raise SerialException(5, "Input/output error")

    def write(self, data: bytes) -> int:
        self._check()
        self.written += data
        self._bytes += self._answer(data)
        return len(data)

    @property
    def in_waiting(self) -> int:
        self._check()
        return len(self._bytes)

    def read(self, size: int) -> bytes:
        self._check()
        data, self._bytes = self._bytes[:size], self._bytes[size:]
        return data

    def close(self) -> None:
        pass


@pytest.fixture
def scripted() -> Callable[[Callable[[bytes], bytes]], Port]:
    return lambda answer: Port("scripted", Scripted(answer))
