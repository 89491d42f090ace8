"""When to say that a rig has drifted: beyond a limit, so surely that chance says it less than once a month."""

from __future__ import annotations

import json
import math
import urllib.request
from http.client import HTTPException
from typing import NamedTuple
from urllib.parse import urlsplit

import torch
from torch import Tensor

from kcal.errors import InputError

# Degrees of the relative attitude: 0.005° of yaw is 4 % of the range at 5 km with a baseline of 10 m.
LIMIT = 0.005
_MONTH = 30 * 86400.0
# Seconds for an answer; what was not delivered is tried again at the next look.
_PATIENCE = 5.0


def alarm_sigmas(every_s: float) -> float:
    """Standard deviations by which a limit must be exceeded, for less than one false alarm a month.

    Three angles and two signs are looked at every so many seconds; that looks agree with each other makes it rarer.

    Example:
        >>> round(alarm_sigmas(60.0), 2)
        4.47
    """
    tries = 6.0 * _MONTH / every_s
    return math.sqrt(2.0) * float(torch.erfinv(torch.tensor(1.0 - 2.0 / tries, dtype=torch.float64)))


class Exceeded(NamedTuple):
    """Which of three angles (..., 3) are beyond the limit, and whether any is (...)."""

    angles: Tensor
    any: Tensor


def exceeded(turn: Tensor, sigma: Tensor, limit_deg: float, every_s: float) -> Exceeded:
    """Whether a relative turn (..., 3) with standard deviations (..., 3), radians, is surely beyond a limit."""
    beyond = turn.abs() - alarm_sigmas(every_s) * sigma > math.radians(limit_deg)
    return Exceeded(beyond, beyond.any(-1))


class Webhook:
    """Send alarms to an address as JSON; what is not delivered waits, the newest only.

    Args:
        address: http:// or https://.

    Raises:
        InputError: another kind of address.
    """

    def __init__(self, address: str) -> None:
        if urlsplit(address).scheme not in ("http", "https") or not urlsplit(address).hostname:
            raise InputError("--alarm: write http://... or https://..., or exit")
        self.address, self.failed, self._waiting = address, 0, b""

    def send(self, message: dict[str, object]) -> None:
        """Send a message, in place of one that still waits."""
        self._waiting = json.dumps(message).encode()
        self.again()

    def again(self) -> None:
        """Try to send what waits."""
        if not self._waiting:
            return
        request = urllib.request.Request(
            self.address, self._waiting, {"Content-Type": "application/json"}, method="POST"
        )
        try:
            with urllib.request.urlopen(request, timeout=_PATIENCE):
                self._waiting = b""
        except (OSError, ValueError, HTTPException):
            self.failed += 1
