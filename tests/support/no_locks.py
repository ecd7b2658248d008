"""`python -m tests.support.no_locks ERRNO COMMAND...`: run a command for which POSIX locks fail.

A seccomp filter makes the kernel answer `fcntl(F_SETLK)` with the error; it outlives exec. Exit code 77: this
host has no such filter.
"""

import ctypes
import os
import platform
import struct
import sys

FCNTL = {"x86_64": 72, "aarch64": 25}
PR_SET_NO_NEW_PRIVS, PR_SET_SECCOMP, FILTER_MODE = 38, 22, 2
LOAD, EQUAL, RETURN = 0x20, 0x15, 0x06  # of classic BPF
ALLOW, FAIL = 0x7FFF0000, 0x00050000
NUMBER, SECOND_ARGUMENT = 0, 24  # offsets in `seccomp_data`
F_SETLK, F_SETLKW = 6, 7
UNAVAILABLE = 77


def main():
    error, *command = sys.argv[1:]
    program = [
        (LOAD, 0, 0, NUMBER),
        (EQUAL, 0, 3, FCNTL.get(platform.machine(), 0)),
        (LOAD, 0, 0, SECOND_ARGUMENT),
        (EQUAL, 2, 0, F_SETLK),
        (EQUAL, 1, 0, F_SETLKW),
        (RETURN, 0, 0, ALLOW),
        (RETURN, 0, 0, FAIL | int(error)),
    ]
    code = ctypes.create_string_buffer(b"".join(struct.pack("HBBI", *each) for each in program))
    header = struct.pack("HxxxxxxQ", len(program), ctypes.addressof(code))
    libc = ctypes.CDLL(None, use_errno=True)
    if platform.machine() not in FCNTL or libc.prctl(PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0):
        sys.exit(UNAVAILABLE)
    if libc.prctl(PR_SET_SECCOMP, FILTER_MODE, ctypes.create_string_buffer(header), 0, 0):
        sys.exit(UNAVAILABLE)
    os.execvp(command[0], command)


if __name__ == "__main__":
    main()
