import numpy as np

from sgam_sfm.merging.keypoints import CollectionKeypoints
from sgam_sfm.runs import assembly


def test_a_large_matches_file_is_left_out_with_a_warning_unless_it_is_asked_for(tmp_path, monkeypatch, caplog):
    merged = CollectionKeypoints(
        keypoints={"a": np.zeros((2, 2), np.float32), "b": np.ones((1, 2), np.float32)},
        matches={("a", "b"): np.array([[1, 0]], np.uint32)},
        scores={("a", "b"): np.ones(1, np.float32)},
        num_raw=1,
        num_duplicates=0,
        num_conflicts=0,
        num_inconsistent=0,
    )
    assembly.write_for_hloc(merged, tmp_path)
    assert (tmp_path / "matches.h5").exists()
    monkeypatch.setattr(assembly, "_LARGEST_MATCHES_H5", 1000)
    assembly.write_for_hloc(merged, tmp_path)
    assert (tmp_path / "keypoints.h5").exists()
    assert not (tmp_path / "matches.h5").exists()
    assert "matches.h5 is left out: in hloc's layout the matches of 1 pairs take about 0.0 GB" in caplog.text
    assert f"`sgam-sfm aggregate '{tmp_path}' --hloc` writes it" in caplog.text
    assembly.write_for_hloc(merged, tmp_path, large=True)
    assert (tmp_path / "matches.h5").exists()
