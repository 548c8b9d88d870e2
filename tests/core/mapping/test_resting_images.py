"""Images on disk: many in a file and a mapping, whose room is taken again; a disk that is full costs memory, no map."""

from __future__ import annotations

import gc
import mmap
import sys
import threading
import weakref
from pathlib import Path

import numpy as np
import pytest
import torch

from mvsgs_core.mapping import resting_images
from mvsgs_core.mapping.keyframes import RGBDKeyframe, TrainingView, training_view
from mvsgs_core.mapping.resting_images import SLOTS, on_disk, rest
from mvsgs_core.stats import Stats
from tests.support.full_disk import full_after
from tests.support.patience import LONG

MAPS, FILES = Path("/proc/self/maps"), Path("/proc/self/fd")


def image(value: int, shape: tuple[int, ...] = (30, 50, 3)) -> torch.Tensor:
    return torch.full(shape, value % 251, dtype=torch.uint8)


def view_of(value: int) -> TrainingView:
    shape = (8, 10)
    given = RGBDKeyframe(
        value, image(value, (*shape, 3)).numpy(), np.ones(4), np.eye(4), np.ones(shape, np.float32),
        mask=np.arange(80).reshape(shape) != value,
    )  # fmt: skip
    return training_view(given, np.eye(4), None, torch.device("cpu"))


def test_two_threads_do_not_take_the_same_room(monkeypatch: pytest.MonkeyPatch) -> None:
    """As two maps in one program might: the second comes when the first has seen that there is room."""
    monkeypatch.setattr(resting_images, "SLOTS", 2)
    monkeypatch.setattr(resting_images, "_files", weakref.WeakSet())
    found = {7: on_disk(image(7))}  # of a file with room for one more
    second = threading.Thread(target=lambda: found.update({8: on_disk(image(8))}))

    class Interrupted(list[int]):
        def __len__(self) -> int:
            count = super().__len__()
            if second.ident is None:
                second.start()
                second.join(0.2)
            return count

    (file,) = resting_images._files
    file.free = Interrupted(file.free)
    found[9] = on_disk(image(9))
    second.join(LONG)
    assert {k for k, kept in found.items() if torch.equal(kept, image(k))} == {7, 8, 9}


@pytest.mark.skipif(sys.platform != "linux", reason="mappings are counted as Linux tells them")
def test_more_images_than_the_system_maps_files_are_kept() -> None:
    before = len(MAPS.read_text().splitlines()), len(list(FILES.iterdir()))
    kept = [on_disk(image(k)) for k in range(3 * SLOTS)]
    assert len(MAPS.read_text().splitlines()) - before[0] < 20
    assert len(list(FILES.iterdir())) - before[1] < 20
    assert all(torch.equal(found, image(k)) for k, found in enumerate(kept))
    del kept
    gc.collect()
    assert len(list(FILES.iterdir())) <= before[1], "the files go with their images"


def test_an_image_takes_the_room_of_one_that_was_let_go() -> None:
    first, others = on_disk(image(0)), [on_disk(image(1)) for _ in range(10)]
    files = set(resting_images._files)
    for k in range(2 * SLOTS):
        last = on_disk(image(k))
    assert set(resting_images._files) == files
    assert torch.equal(first, image(0))
    assert all(torch.equal(other, image(1)) for other in others)
    assert torch.equal(last, image(2 * SLOTS - 1))


def test_the_room_of_an_image_that_is_still_looked_at_is_not_given_away() -> None:
    rows = on_disk(image(7))[3:5].numpy()  # as a thread that writes a checkpoint
    gc.collect()
    taken = [on_disk(image(8)) for _ in range(SLOTS)]
    np.testing.assert_array_equal(rows, 7)
    assert len(taken) == SLOTS


def test_a_mask_of_any_size_comes_back_as_it_was() -> None:
    for shape in ((1, 1), (70, 90), (mmap.PAGESIZE // 64, 64), (mmap.PAGESIZE // 64 + 1, 64)):
        mask = torch.rand(shape) < 0.5
        found = on_disk(mask)
        assert torch.equal(found, mask)
        assert found.data_ptr() % 64 == 0, "of memory that is aligned otherwise a sum may round otherwise"


def test_where_disk_or_system_take_no_more_an_image_stays_in_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    log = Stats()
    one, other, third = (view_of(k) for k in (1, 2, 3))
    with full_after(0):
        assert not rest(one, log)

    def no_more(*_: object) -> mmap.mmap:
        raise OSError(12, "Cannot allocate memory")

    with monkeypatch.context() as patch:
        patch.setattr(resting_images, "_files", set())
        patch.setattr(mmap, "mmap", no_more)
        assert not rest(other, log)
    assert not one.image_on_disk
    assert not other.image_on_disk
    assert [text.rpartition(": ")[0] for text in log.warnings] == 2 * [
        "images stay in memory beyond mapper.images_in_memory"
    ]
    assert rest(third, log)
    for k, view in enumerate((one, other, third), 1):
        assert torch.equal(view.image, image(k, (8, 10, 3)))
        assert view.valid is not None
        assert torch.equal(view.valid, torch.arange(80).reshape(8, 10) != k)
