"""Runs Python code that dies as soon as it asks for the network: ``python offline.py CODE``.

The kernel itself watches (seccomp), so that nothing below Python gets around it, no name is looked
up and no thread is overlooked. It needs no other program and no right. What is refused in Python
would not be refused to libraries in C.
"""

from __future__ import annotations

import ctypes
import errno
import platform
import socket
import struct
import sys

UNAVAILABLE = 75
"""Exit status where the kernel does not offer this."""

# linux/audit.h, and asm/unistd.h: socket, execve, execveat, io_uring_setup.
_MACHINES = {
    "x86_64": (0xC000003E, 41, 59, 322, 425),
    "aarch64": (0xC00000B7, 198, 221, 281, 425),
}
# linux/prctl.h, linux/seccomp.h, linux/bpf_common.h
_SET_NO_NEW_PRIVS, _SET_SECCOMP, _MODE_FILTER = 38, 22, 2
_KILL_PROCESS, _ALLOW, _FAIL = 0x80000000, 0x7FFF0000, 0x00050000
_LOAD, _JUMP_IF_EQUAL, _RETURN = 0x20, 0x15, 0x06
_NUMBER, _ARCHITECTURE, _FIRST_ARGUMENT = 0, 4, 16


def available() -> bool:
    """Whether this is a kernel and a processor whose calls are known here."""
    return sys.platform == "linux" and platform.machine() in _MACHINES


def forbid_network() -> None:
    """Let this process, with all its threads, die at the first socket that could leave the machine.

    Other programs cannot be started, since they would die unnoticed. Local sockets are refused, not
    deadly: without them the C library asks no local service to look a name up for it, and has to
    use the network for it. Sockets to the kernel itself (which interfaces are there?) are allowed.

    Raises:
        OSError: The kernel does not offer it.
    """
    architecture, make_socket, execute, execute_at, make_ring = _MACHINES[platform.machine()]
    deadly, refused, absent, allowed = 10, 11, 12, 13
    program = [
        (_LOAD, _ARCHITECTURE, 0, 0),
        (_JUMP_IF_EQUAL, architecture, 2, deadly),
        (_LOAD, _NUMBER, 0, 0),
        (_JUMP_IF_EQUAL, execute, refused, 4),
        (_JUMP_IF_EQUAL, execute_at, refused, 5),
        (_JUMP_IF_EQUAL, make_ring, absent, 6),
        (_JUMP_IF_EQUAL, make_socket, 7, allowed),
        (_LOAD, _FIRST_ARGUMENT, 0, 0),
        (_JUMP_IF_EQUAL, socket.AF_UNIX, refused, 9),
        (_JUMP_IF_EQUAL, socket.AF_NETLINK, allowed, deadly),
        (_RETURN, _KILL_PROCESS, 0, 0),
        (_RETURN, _FAIL | errno.EACCES, 0, 0),
        (_RETURN, _FAIL | errno.ENOSYS, 0, 0),
        (_RETURN, _ALLOW, 0, 0),
    ]
    code = b"".join(
        # Jumps are counted from the next instruction.
        struct.pack("HBBI", kind, *((yes - i - 1, no - i - 1) if yes else (0, 0)), value)
        for i, (kind, value, yes, no) in enumerate(program)
    )
    instructions = ctypes.create_string_buffer(code, len(code))
    header = struct.pack("HxxxxxxP", len(program), ctypes.addressof(instructions))
    libc = ctypes.CDLL(None, use_errno=True)
    for arguments in (
        (_SET_NO_NEW_PRIVS, 1, 0, 0, 0),
        (_SET_SECCOMP, _MODE_FILTER, ctypes.c_char_p(header), 0, 0),
    ):
        if libc.prctl(*arguments):
            raise OSError(ctypes.get_errno(), "the kernel forbids nothing")


if __name__ == "__main__":
    try:
        forbid_network()
    except OSError:
        sys.exit(UNAVAILABLE)
    exec(compile(sys.argv[1], "offline", "exec"), {"__name__": "offline"})
