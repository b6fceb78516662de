"""`tgdsl hand probe`, and how commands find a hand, with emulated hands."""

import os

from faulty_lines import Faults, FaultyEmulator
from first_order_hands import first_order_hand

from tgdsl.runtime.xhand1.wire import ports
from tgdsl.runtime.xhand1.wire.client import SerialTiming
from tgdsl.runtime.xhand1.wire.protocol import Command


def pseudo_terminal() -> tuple[int, int, str]:
    """Return both ends and the name of a serial port without a device."""
    ends = os.openpty()
    return *ends, os.ttyname(ends[1])


def test_probe_describes_each_port(emulator, plugged, here, tmp_path):
    first_end, second_end, silent = pseudo_terminal()
    try:
        plugged(emulator.device, silent, "/dev/none")
        code, output, error = here(tmp_path, "hand", "probe")
    finally:
        os.close(first_end)
        os.close(second_end)
    assert (code, error) == (0, "")
    lines = output.splitlines()
    assert lines[0] == f"{emulator.device} (an adapter)"
    identity = 'version "tgdsl emulator", side 01, serial number "X1-0042", name ff 00'
    assert lines[1] == f"  {emulator.device}: hand 0, {identity}"
    assert lines[2] == f"{silent}: no hand answers"
    assert lines[3].startswith("/dev/none: /dev/none cannot be opened at 3000000 baud: ")
    assert len(lines) == 4
    assert {frame.command for _, frame in emulator.requests} == {Command.VERSION, Command.READ_REGISTER}


def test_probe_of_one_port(emulator, plugged, here, tmp_path):
    plugged("/dev/none")
    code, output, _ = here(tmp_path, "hand", "probe", "--port", emulator.device)
    assert (code, len(output.splitlines())) == (0, 2)
    code, _, error = here(tmp_path, "hand", "probe", "--port", "/dev/none")
    assert code == 2
    assert error.startswith("tgdsl: /dev/none cannot be opened")


def test_a_computer_without_ports(plugged, here, tmp_path):
    plugged()
    assert here(tmp_path, "hand", "probe") == (0, "this computer has no serial port\n", "")
    assert here(tmp_path, "hand", "monitor") == (2, "", "tgdsl: no hand answers; this computer has no serial port\n")


def test_no_hand_or_several_hands_are_errors_that_list_them(emulator, plugged, here, tmp_path, monkeypatch):
    with FaultyEmulator(first_order_hand(3)) as second:
        plugged(emulator.device, second.device)
        with monkeypatch.context() as patient:  # two emulators on a busy computer
            patient.setattr(ports, "_PATIENT", SerialTiming(reply_timeout_s=0.4))
            code, _, error = here(tmp_path, "hand", "monitor", "--seconds", "0.1")
        assert code == 2
        hands = f"{emulator.device} (id 0), {second.device} (id 3)"
        assert error == f"tgdsl: 2 hands answer: {hands}; choose one with --port or --hand-id\n"
        code, output, error = here(tmp_path, "hand", "monitor", "--seconds", "0.1", "--hand-id", "3")
        assert code == 0, error
        assert output.startswith(f"{second.device}: hand 3\n")
        code, _, error = here(tmp_path, "hand", "monitor", "--hand-id", "5")
        assert (
            error
            == f"tgdsl: no hand with id 5 answers; {emulator.device} (an adapter): no hand answers; {second.device}: no hand answers\n"
        )
    emulator.set_faults(Faults(silence=1.0))
    plugged(emulator.device)
    code, _, error = here(tmp_path, "hand", "monitor")
    assert error == f"tgdsl: no hand answers; {emulator.device} (an adapter): no hand answers\n"
    code, _, error = here(tmp_path, "hand", "monitor", "--port", emulator.device)
    assert error == f"tgdsl: no hand answers on {emulator.device}; is it switched on, and is this its port?\n"
