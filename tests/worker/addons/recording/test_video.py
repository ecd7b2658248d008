"""A video whose disk is full says so, and leaves nothing there."""

import numpy as np
import pytest

from dreamfleet.common.errors import DreamfleetError
from dreamfleet.worker.addons.recording.video import Video
from tests.support.disks import small_disk

NOISE = np.random.default_rng(1).integers(0, 255, (128, 128, 3)).astype(np.uint8)


def film(path, pictures, error=None, **more):
    with Video(path, 10, **more) as video:
        for _ in range(pictures):
            video.add(NOISE)
        if error is not None:
            raise error


@pytest.mark.parametrize("keep_partial", [False, True])
@pytest.mark.parametrize("pictures", [1, 200])  # written as the video ends, and before
def test_a_full_disk_is_named_and_keeps_no_part(tmp_path, keep_partial, pictures):
    with small_disk(tmp_path / "disk", 1) as disk:
        if disk is None:
            pytest.skip("no right to mount a disk")
        disk.fill()
        with pytest.raises(DreamfleetError, match=r"drive\.mp4"):
            film(disk.path / "drive.mp4", pictures, keep_partial=keep_partial)
        disk.free()
        assert list(disk.path.iterdir()) == []
        film(disk.path / "drive.mp4", 2)
        assert [each.name for each in disk.path.iterdir()] == ["drive.mp4"]


@pytest.mark.parametrize(("keep_partial", "kept"), [(False, []), (True, ["drive.mp4"])])
def test_an_error_of_the_drive_is_the_drives_own(tmp_path, keep_partial, kept):
    with pytest.raises(FileNotFoundError, match="of the simulator"):
        film(tmp_path / "drive.mp4", 1, keep_partial=keep_partial, error=FileNotFoundError(2, "of the simulator"))
    assert [each.name for each in tmp_path.iterdir()] == kept
