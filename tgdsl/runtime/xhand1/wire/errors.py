"""Errors of an XHand1."""

from __future__ import annotations

from tgdsl.errors import HandError as HandError


class ProtocolError(HandError):
    """Bytes that are not what the protocol says, or values that its fields cannot hold."""


class HandDisconnectedError(HandError):
    """A serial port that cannot be opened, or that went away."""


class HandTimeoutError(HandError):
    """No sound answer of the hand in time: none came, it was damaged, of another address, or too old."""


class HandRefusedError(HandError):
    """A request that the hand answered with its error command."""


class HandClosedError(HandError):
    """A driver that was closed, or whose reader ended."""


class MotionError(HandError):
    """A command that is outside the motion limits, or that comes where no motion is allowed. The hand is passive."""


class WatchdogError(MotionError):
    """No command came in time, so the hand turned passive."""
