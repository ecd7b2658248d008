"""A fleet with join files: an authority, a coordinator and workers."""

from dreamfleet.common.addons.access.authority import Authority
from dreamfleet.common.security.credentials import read_join_file
from dreamfleet.common.transport.session import Network
from tests.support import tasks


class Access:
    """An authority, with a join file for each actor."""

    def __init__(self, folder, **how):
        self.folder = folder
        self.authority = Authority.create(folder, **how)
        somewhere = ["tls/127.0.0.1:7447"]
        self.authority.issue("coordinator", "home", self.path("coordinator"), hosts=["home.example"])
        for role, name in (("worker", "first"), ("worker", "second"), ("viewer", "viewer"), ("operator", "operator")):
            self.authority.issue(role, name, self.path(name), connect=somewhere)

    def path(self, name):
        return self.folder / f"{name}.join"

    def network(self, name, endpoint):
        return Network(connect=(endpoint,), credentials=read_join_file(self.path(name)))


def begin(processes, access, endpoint, bundle, *more, name="safe", inside=()):
    process = processes.start(
        "coordinator", "--run", name, "--runs-dir", processes.runs, "--beat", 0.2, "--listen", endpoint,
        "--join", access.path("coordinator"), "--access-dir", access.folder,
        *(("--bundle", bundle.path) if bundle else ()),
        "--task", tasks.SLOW_TOY, "--population", 4, "--episodes", 1, "--evaluate-every", 0, *more,
        inside=inside,
    )  # fmt: skip
    process.wait_until_serving()
    return process


def work(processes, access, endpoint, who, name="safe", *more):
    return processes.start(
        "worker", "--join", access.path(who), "--connect", endpoint, "--run", name, "--slots", 1,
        "--task", tasks.SLOW_TOY, *more,
    )  # fmt: skip
