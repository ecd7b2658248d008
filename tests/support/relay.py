"""A TCP relay whose connections a test can cut, slow down, or hold."""

import socket
import struct
import threading
import time
from contextlib import suppress

from tests.support.processes import free_port

RESET_ON_CLOSE = struct.pack("ii", 1, 0)


class Relay:
    """Forwards connections to a port of this host, or of the host at `far`."""

    def __init__(self, target, address="127.0.0.1", far="127.0.0.1"):
        self.delay = 0.0  # seconds added to every piece
        self.rate = 0.0  # bytes a second in each direction of a connection; 0: unlimited
        self._target = far, target
        self._flowing = threading.Event()
        self._flowing.set()
        self._pairs = []
        self.port = free_port()
        self.endpoint = f"tcp/{address}:{self.port}"
        self._server = socket.create_server((address, self.port))
        self._threads = []
        self._run(self._accept)

    def hold(self):
        """Hold all data, without closing connections."""
        self._flowing.clear()

    def release(self):
        """Forward again, beginning with the held data."""
        self._flowing.set()

    def cut(self):
        """Close every connection; new ones are accepted."""
        pairs, self._pairs = self._pairs, []
        for each in (one for pair in pairs for one in pair):
            with suppress(OSError):  # its pump has ended already
                each.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, RESET_ON_CLOSE)
                each.shutdown(socket.SHUT_RDWR)

    def close(self):
        self._server.shutdown(socket.SHUT_RDWR)
        self.release()
        self.cut()
        for thread in self._threads:
            thread.join()
        self._server.close()

    def _accept(self):
        while True:
            try:
                near, _ = self._server.accept()
            except OSError:
                return
            try:
                far = socket.create_connection(self._target)
            except OSError:  # nothing listens there now
                near.close()
                continue
            self._pairs.append((near, far))
            for source, sink in ((near, far), (far, near)):
                self._run(self._pump, source, sink)

    def _run(self, target, *arguments):
        self._threads.append(threading.Thread(target=target, args=arguments, daemon=True))
        self._threads[-1].start()

    def _pump(self, source, sink):
        with source, suppress(OSError):
            while data := source.recv(65536):
                time.sleep(self.delay + (len(data) / self.rate if self.rate else 0.0))
                self._flowing.wait()
                sink.sendall(data)
        with suppress(OSError):
            sink.shutdown(socket.SHUT_RDWR)
