"""Which runs this user began on this host: the user named their task, so its module stays trusted for them.

A file in the user's state folder remembers each. Nothing that travels says it: not a run's folder, and not the cache.
"""

import json
import logging
import os
from pathlib import Path

from dreamfleet.common.host.trusted_modules import is_trusted, module_folder
from dreamfleet.common.protocol.tasks import module_of

log = logging.getLogger(__name__)


def remember_run(uid: str, task: str, options: str) -> None:
    """Note that this user began a run in a task whose name chooses a trusted module; nothing of other tasks."""
    module = module_of(task)
    if not module or not is_trusted(module):
        return
    try:
        path = own_runs_dir() / uid  # docs/how-to/trust.md says what follows
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        path.write_text(json.dumps([task, options, str(module_folder(module) or "")]))
    except (OSError, RuntimeError) as error:
        log.warning("other verbs will need --trust %s for this run: %s", module, error)


def own_runs_dir() -> Path:
    """Where a file named after its UID remembers each; `RuntimeError` if this user has no home."""
    return Path(os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state") / "dreamfleet" / "own-runs"
