"""Why a link cannot be opened: the program that has the port, and what to do about each cause."""

from __future__ import annotations

import errno
import os
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from paramclient.errors import LinkError, UsageError
from paramclient.links import SerialPort, create_link, refusals
from paramclient.links.port_users import user_of_device, user_of_port
from paramclient.links.refusals import device_refusal, host_refusal, port_in_use, socket_refusal

linux_only = pytest.mark.skipif(sys.platform != "linux", reason="other systems have no /proc")

HOLDER = """
import socket, sys
sock = socket.socket(socket.{family}, socket.{kind})
sock.bind(("{host}", 0))
if socket.{kind} == socket.SOCK_STREAM:
    sock.listen()
print(sock.getsockname()[1], flush=True)
sys.stdin.read()
"""


@contextmanager
def another_program(tmp_path: Path, kind: str, family: str = "AF_INET") -> Iterator[tuple[int, int]]:
    """Another program that has a port; yields its process id and the port."""
    script = tmp_path / "groundstation.py"
    host = "127.0.0.1" if family == "AF_INET" else "::1"
    script.write_text(HOLDER.format(kind=kind, family=family, host=host))
    with subprocess.Popen(
        [sys.executable, script], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as program:
        assert program.stdout is not None
        try:
            yield program.pid, int(program.stdout.readline())
        finally:
            program.kill()


@linux_only
@pytest.mark.asyncio
@pytest.mark.parametrize("kind", ["udpin", "tcpin"])
async def test_the_program_that_has_the_port_is_named(tmp_path: Path, kind: str) -> None:
    with another_program(tmp_path, "SOCK_STREAM" if kind == "tcpin" else "SOCK_DGRAM") as (pid, port):
        with pytest.raises(LinkError) as caught:
            await create_link(f"{kind}:127.0.0.1:{port}").open()
        used = f"{kind}:127.0.0.1:{port}: port {port} is in use by groundstation.py (process {pid}). "
        assert str(caught.value).startswith(f"{used}Close that program, or choose another port")
        assert ("MAVLink router" in str(caught.value)) is (kind == "udpin")
        assert isinstance(caught.value.__cause__, OSError)


@linux_only
def test_a_port_of_an_ipv6_socket_and_of_the_other_protocol(tmp_path: Path) -> None:
    with another_program(tmp_path, "SOCK_DGRAM", "AF_INET6") as (pid, port):
        assert user_of_port(port, is_tcp=False) == f"groundstation.py (process {pid})"
        assert user_of_port(port, is_tcp=True) is None
    assert user_of_port(port, is_tcp=False) is None


@linux_only
def test_the_program_that_has_a_device_is_named(tmp_path: Path) -> None:
    device = tmp_path / "ttyUSB0"
    device.touch()
    (tmp_path / "by-id").symlink_to(device)
    assert user_of_device(str(device)) is None
    program = [sys.executable, "-c", "import sys; f = open(sys.argv[1]); print(flush=True); sys.stdin.read()"]
    with subprocess.Popen(
        [*program, str(device)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as holder:
        assert holder.stdout is not None
        holder.stdout.readline()
        expected = f"{Path(sys.executable).name} (process {holder.pid})"
        assert user_of_device(str(tmp_path / "by-id")) == expected
        assert device_refusal(str(device), 57600, OSError(errno.EBUSY, "busy")) == (
            f"{device} is in use by {expected}. Close that program, or let it forward MAVLink"
        )
        holder.communicate("")


def proc(tmp_path: Path, *, readable: bool) -> Path:
    """A process file system of one process, which has UDP port 14550."""
    (tmp_path / "net").mkdir()
    (tmp_path / "net" / "udp").write_text(
        "  sl  local_address rem_address   st tx_queue rx_queue tr tm->when retrnsmt   uid  timeout inode\n"
        "  7: 00000000:38D6 00000000:0000 07 00000000:00000000 00:00000000 00000000     0        0 4242 2\n"
    )
    process = tmp_path / "77"
    (process / "fd").mkdir(parents=True)
    (process / "cmdline").write_bytes(b"/opt/QGroundControl\0--fast\0")
    if readable:
        (process / "fd" / "3").symlink_to("socket:[4242]")
    return tmp_path


def test_a_process_that_may_be_read(tmp_path: Path) -> None:
    found = user_of_port(14550, is_tcp=False, proc=proc(tmp_path, readable=True))
    assert found == "QGroundControl (process 77)"


def test_a_process_of_another_user(tmp_path: Path) -> None:
    found = user_of_port(14550, is_tcp=False, proc=proc(tmp_path, readable=False))
    assert found == "a program of the user root"


def test_a_system_that_does_not_report_users_of_ports(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert user_of_port(14550, is_tcp=False, proc=tmp_path / "none") is None
    assert user_of_device("/dev/ttyUSB0", proc=tmp_path / "none") is None
    monkeypatch.setattr(refusals, "user_of_port", lambda port, is_tcp: None)
    assert port_in_use(5760, is_tcp=True) == (
        "port 5760 is in use by another program. Close that program, or choose another port"
    )


def test_modem_manager_gives_the_port_back(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(refusals, "user_of_device", lambda _: "ModemManager (process 5)")
    reported = device_refusal("/dev/ttyACM0", 57600, OSError(errno.EBUSY, "busy"))
    assert reported.endswith("Wait 30 s, or stop it: sudo systemctl stop ModemManager")


@pytest.mark.parametrize(
    ("error", "text"),
    [
        (TimeoutError(), "no response from a:5. Check the address, the network and firewalls"),
        (
            ConnectionRefusedError(errno.ECONNREFUSED, "refused"),
            "connection refused by a:5: nothing listens there. Is the vehicle or simulator running?",
        ),
        (
            OSError(errno.EADDRNOTAVAIL, "no"),
            "a is not an address of this computer; 0.0.0.0 listens on all of them",
        ),
        (
            OSError(errno.EHOSTUNREACH, "No route to host"),
            "no route to a:5: No route to host. Is this computer in the network of the vehicle?",
        ),
        (
            PermissionError(errno.EACCES, "no"),
            "no permission to use port 5: ports below 1024 need privileges",
        ),
        (OSError(errno.EMFILE, os.strerror(errno.EMFILE)), "cannot open: Too many open files"),
    ],
)
def test_causes_of_sockets(error: OSError, text: str) -> None:
    assert socket_refusal(error, "a", 5, "a:5") == text


def test_a_host_without_an_address() -> None:
    unknown = host_refusal("drnoe.local", socket.gaierror(socket.EAI_NONAME, "Name or service not known"))
    assert unknown == (
        "host drnoe.local not found: Name or service not known. Check the spelling, or use the IP address"
    )
    offline = host_refusal("a", socket.gaierror(socket.EAI_AGAIN, "Temporary failure"))
    assert "no name server answers (Temporary failure). Is this computer online?" in offline


def test_a_long_list_of_serial_ports_is_cut(monkeypatch: pytest.MonkeyPatch) -> None:
    missing = OSError(errno.ENOENT, "no")
    many = [SerialPort(f"/dev/ttyS{number}") for number in range(20)]
    monkeypatch.setattr(refusals, "list_ports", lambda: many)
    assert device_refusal("/dev/x", 57600, missing).endswith("/dev/ttyS7 and 12 more")

    def fail() -> None:
        raise UsageError("serialx is missing")

    monkeypatch.setattr(refusals, "list_ports", fail)
    reported = device_refusal("/dev/x", 57600, missing)
    assert reported == "/dev/x does not exist. 'paramclient ports' lists the serial ports"
