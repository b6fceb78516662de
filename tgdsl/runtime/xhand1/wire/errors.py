"""Errors of the XHand1 on its serial line, each by name."""

from __future__ import annotations

from tgdsl.errors import HandError as HandError


class ProtocolError(HandError):
    """Bytes that are not what the protocol says, or values that its fields cannot hold."""


class HandDisconnectedError(HandError):
    """A serial port that cannot be opened, or that went away."""


class HandTimeoutError(HandError):
    """A hand that did not answer in time."""


class HandChecksumError(HandError):
    """An answer that arrived damaged."""


class HandAddressError(HandError):
    """Answers that came, but from or to another address than the hand's."""


class HandRefusedError(HandError):
    """A request that the hand answered with its error command."""


class StaleReadingError(HandError):
    """No reading that is both new and recent enough."""


class HandClosedError(HandError):
    """A driver that was closed, or whose reader ended."""


class MotionError(HandError):
    """A command that is outside the motion limits, or that comes where no motion is allowed. The hand is passive."""


class WatchdogError(MotionError):
    """No command came in time, so the hand was made passive."""
