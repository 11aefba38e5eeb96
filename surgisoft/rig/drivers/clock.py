"""The clock of a device against that of the computer."""

import math
from collections import deque


class ClockMap:
    """Offset between a sender's clock and the receiver's, from the times of its messages.

    A message is never received before it was sent, and the transport's delay varies, so that the
    smallest difference of a window is nearest to the offset (Cristian 1989). The window follows a
    drift of the clocks: at 50 ppm it is off by 0.5 ms in 10 s.
    """

    def __init__(self, window_s: float = 10.0) -> None:
        """window_s: length of the window, receiver's clock [s]."""
        self.window_s = window_s
        self._least: deque[tuple[float, float]] = deque()

    def add(self, sent_s: float, received_s: float) -> None:
        """Take a message into account: the sender's time and the receiver's [s]."""
        offset = received_s - sent_s
        while self._least and self._least[-1][1] >= offset:
            self._least.pop()
        self._least.append((received_s, offset))
        while self._least[0][0] < received_s - self.window_s:
            self._least.popleft()

    @property
    def offset_s(self) -> float:
        """Receiver's clock minus sender's [s]; nan before the first message."""
        return self._least[0][1] if self._least else math.nan
