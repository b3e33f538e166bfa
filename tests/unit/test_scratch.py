import numpy as np
import pytest

from sgam_sfm.merging import scratch
from sgam_sfm.merging.scratch import Scratch, batches


def test_rows_are_read_as_they_were_written_and_the_folder_goes_even_after_an_error(tmp_path):
    folder = tmp_path / "below" / ".scratch"
    folder.mkdir(parents=True)
    (folder / "of a run that was killed").touch()
    with Scratch(folder) as made:
        rows = made.rows("points", 2, np.float32)
        rows.append(np.array([[1, 2], [3, 4]]))
        rows.write(4, np.array([[9, 8]]))
        assert rows.count == 5
        np.testing.assert_array_equal(rows.read(1, 1), [[3, 4]])
        np.testing.assert_array_equal(rows.read(4, 1), [[9, 8]])
        assert rows.read(1, 0).shape == (0, 2)
        np.testing.assert_array_equal(rows.read_parts([(4, 1), (0, 0), (0, 2)]), [[9, 8], [1, 2], [3, 4]])
        assert [path.name for path in folder.iterdir()] == ["points"]
    assert not folder.exists()
    with pytest.raises(RuntimeError), Scratch(folder):
        raise RuntimeError
    assert not folder.exists()


def test_sorted_rows_come_by_label_and_in_the_order_in_which_they_were_put(tmp_path, monkeypatch):
    monkeypatch.setattr(scratch, "_BUFFERED", 40)  # bytes: most are on disk before they are taken
    monkeypatch.setattr(scratch, "_ROWS_AT_ONCE", 3)
    rng = np.random.default_rng(0)
    labels, values = rng.integers(0, 5, 60), np.arange(120).reshape(60, 2)
    with Scratch(tmp_path / "s") as made:
        rows = made.sorted("rows", 2, np.int32)
        for begin in range(0, 60, 7):
            rows.put(labels[begin : begin + 7], values[begin : begin + 7])
        rows.put(labels[:0], values[:0])
        parts = list(rows.take())
    assert max(map(len, parts)) == 3
    np.testing.assert_array_equal(np.concatenate(parts), values[np.argsort(labels, kind="stable")])


def test_rows_of_one_label(tmp_path):
    with Scratch(tmp_path / "s") as made:
        rows = made.sorted("rows", 1, np.int32)
        rows.put(np.array([3, 1, 3]), np.array([[5], [6], [7]]))
        assert rows.finish() == [1, 3]
        np.testing.assert_array_equal(rows.take_label(3), [[5], [7]])


def test_batches_hold_what_fits_and_one_item_at_least():
    assert list(batches([3, 4, 9, 1, 1], lambda size: size, 7)) == [[3, 4], [9], [1, 1]]
    assert list(batches([], len, 7)) == []
