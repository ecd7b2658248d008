"""A wall clock that a test sets for one process, by a library that the process preloads."""

import shutil
import subprocess

SOURCE = r"""
#define _GNU_SOURCE
#include <dlfcn.h>
#include <fcntl.h>
#include <stdlib.h>
#include <sys/mman.h>
#include <time.h>

static long offset(void) {  /* seconds, as the file has them now */
    static volatile long *shared;
    if (!shared) {
        int file = open(getenv("WALL_CLOCK_OFFSET"), O_RDONLY);
        void *map = file < 0 ? MAP_FAILED : mmap(0, sizeof(long), PROT_READ, MAP_SHARED, file, 0);
        shared = map == MAP_FAILED ? 0 : map;
    }
    return shared ? *shared : 0;
}

int clock_gettime(clockid_t clock, struct timespec *now) {
    static int (*real)(clockid_t, struct timespec *);
    if (!real) real = dlsym(RTLD_NEXT, "clock_gettime");
    int failed = real(clock, now);
    if (!failed && clock == CLOCK_REALTIME) now->tv_sec += offset();
    return failed;
}

time_t time(time_t *place) {
    struct timespec exact;
    clock_gettime(CLOCK_REALTIME, &exact);
    if (place) *place = exact.tv_sec;
    return exact.tv_sec;
}
"""


class WallClock:
    """The clock of all processes that begin with `inside`; other clocks, by which deadlines are kept, stay true."""

    def __init__(self, folder):
        folder.mkdir(parents=True, exist_ok=True)
        source, self._library, self._offset = (folder / name for name in ("clock.c", "clock.so", "offset"))
        source.write_text(SOURCE)
        subprocess.run(["cc", "-O1", "-shared", "-fPIC", "-o", self._library, source, "-ldl"], check=True)
        self.set(0)

    @staticmethod
    def possible():
        """Whether this host has a compiler."""
        return shutil.which("cc") is not None

    @property
    def inside(self):
        """The words before a command that give it this clock."""
        return "env", f"LD_PRELOAD={self._library}", f"WALL_CLOCK_OFFSET={self._offset}"

    def set(self, seconds):
        """Set the clock so many seconds beside the host's."""
        with self._offset.open("r+b" if self._offset.exists() else "wb") as file:
            file.write(int(seconds).to_bytes(8, "little", signed=True))
