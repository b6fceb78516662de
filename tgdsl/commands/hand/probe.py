"""`tgdsl hand probe`: the hands that are plugged in."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Probe:
    """List the serial ports and the hands that answer on them: versions, names and serial numbers."""

    port: str | None = None
    """The only port to ask; default: all. Whatever is on a port is sent a few bytes, so name it if that could do harm."""
    hand_id: int | None = None
    """The only id to ask for; default: 0 to 7."""

    def run(self) -> None:
        """Print the list."""
        from tgdsl.runtime.xhand1.wire.ports import ask_ports, identify

        ports = ask_ports(self.port, self.hand_id)
        if not ports:
            print("this computer has no serial port")
        for port in ports:
            print(port)
            for hand in port.hands:
                print(f"  {identify(hand)}")
