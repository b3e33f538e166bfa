"""Runs on several machines: shards that are joined, and a Ray cluster that loses a machine, equal to a plain run."""

from __future__ import annotations

import json
import shutil
import threading
import time
from itertools import combinations
from pathlib import Path

import h5py
import pytest

from sgam_sfm import cli
from sgam_sfm.colmap.reading import database_content
from sgam_sfm.exit_codes import DONE, ERROR, SOME_FAILED, USAGE
from sgam_sfm.options import MatchOptions
from sgam_sfm.pairs import write_pairs
from sgam_sfm.runs.runner import match_collection
from tests.room import Room, TrueMatcher, write_room

PAIRS = 6  # of four images, a block each


@pytest.fixture(scope="module")
def folder(room: Room, tmp_path_factory) -> Path:
    folder = write_room(room, tmp_path_factory.mktemp("room"))
    write_pairs(folder / "four.txt", combinations(sorted(room.images)[:4], 2))
    return folder


def given(folder: Path, output: Path, **changes: object) -> MatchOptions:
    values = {
        "images": folder / "images",
        "pairs": folder / "four.txt",
        "cameras": folder / "cameras.txt",
        "labels": folder / "labels",
        "output": output,
        "area_matcher": "none",
        "mask_matches": "1",  # so that label maps are needed all the same
        "block_images": 1,
        "threads": 1,
        "mapping": False,
    }
    return MatchOptions(**(values | changes))


def flags(options: MatchOptions) -> list[str]:
    """The command of the options."""
    names = ("images", "pairs", "cameras", "labels", "output", "block_images", "threads", "matcher", "area_matcher")
    names += ("mask_matches", "executor", "ray_address")
    return [
        *("match", "--no-mapping", "--area-size", "320", "--image-size", "320"),
        *(part for name in names for part in (f"--{name.replace('_', '-')}", str(getattr(options, name)))),
    ]


def raw(output: Path) -> dict[str, dict[str, bytes]]:
    """All that the blocks hold, bit for bit; HDF5's own bytes between the arrays are whatever was in memory."""
    found = {}
    for path in (output / "pairs").iterdir():
        with h5py.File(path) as file:
            held = {name: file[name][()].tobytes() for name in file}
            found[path.name] = held | {"fingerprint": str(file.attrs["fingerprint"]).encode()}
    return found


@pytest.fixture(scope="module")
def matcher(room) -> TrueMatcher:
    return TrueMatcher(room=room)


@pytest.fixture(scope="module")
def whole(folder, matcher, tmp_path_factory) -> Path:
    """The output of a run without shards."""
    output = tmp_path_factory.mktemp("whole")
    match_collection(given(folder, output), point_matcher=matcher)
    return output


@pytest.fixture(scope="module")
def shards(folder, matcher, tmp_path_factory) -> list[Path]:
    """The outputs of three shards."""
    outputs = [tmp_path_factory.mktemp("shards") / str(number) for number in (1, 2, 3)]
    for number, output in enumerate(outputs, start=1):
        match_collection(given(folder, output, shard=f"{number}/3"), point_matcher=matcher)
    return outputs


def copied(shards: list[Path], target: Path) -> list[str]:
    """The shards, to be spoilt."""
    return [str(shutil.copytree(shard, target / shard.name)) for shard in shards]


def error_of(capsys) -> str:
    lines = [line for line in capsys.readouterr().err.splitlines() if line.startswith("error:")]
    assert len(lines) == 1
    return lines[0]


def test_shards_joined_are_the_run_without_shards(whole, shards, tmp_path, capsys):
    for shard in shards:
        assert not (shard / "database.db").exists()
        assert len(raw(shard)) == 2
    assert sum(len(raw(shard)) for shard in shards) == PAIRS
    assert cli.run(["join", *map(str, shards[::-1]), "--output", str(tmp_path)]) == DONE
    assert raw(tmp_path) == raw(whole)
    assert database_content(tmp_path / "database.db") == database_content(whole / "database.db")
    ours, theirs = (json.loads((output / "summary.json").read_text()) for output in (tmp_path, whole))
    for part in ("images", "pairs", "labels", "keypoints"):
        assert ours[part] == theirs[part]
    assert ours["matching_seconds"].keys() == theirs["matching_seconds"].keys()
    maps = {path.relative_to(whole / "labels") for path in (whole / "labels").rglob("*")}
    assert {path.relative_to(tmp_path / "labels") for path in (tmp_path / "labels").rglob("*")} == maps
    # What came out is a run like any other.
    capsys.readouterr()
    assert cli.run(["status", str(tmp_path)]) == DONE
    assert "6 of 6 matched and stored, 0 failed" in capsys.readouterr().out
    assert cli.run(["aggregate", str(tmp_path), "--no-mapping", "--output", str(tmp_path / "again")]) == DONE


def test_a_shard_says_what_it_did_and_ends_well(folder, tmp_path, capsys):
    images = tmp_path / "images"
    shutil.copytree(folder / "images", images)
    (images / "broken.jpg").write_bytes(b"no image")
    output = tmp_path / "out"
    command = [*flags(given(folder, output, images=images, matcher="sift")), "--shard", "6/6"]
    assert cli.run(command) == DONE  # though an image failed: a scheduler is to go on to `join`, which ends with 3
    table = capsys.readouterr().err
    assert "6/6, 1 block of pairs" in table
    assert "1 of 6 matched, 0 failed" in table
    assert "once all shards are done: sgam-sfm join SHARD_OUT... --output OUT" in table
    assert cli.run(["status", str(output)]) == DONE
    assert "shard 6/6 has its own pairs only; `sgam-sfm join`" in capsys.readouterr().out
    (tmp_path / "images" / "broken.jpg").unlink()
    assert cli.run([*command[:-1], "5/6"]) == USAGE
    assert f"'{output}' holds shard 6/6, not 5/6; give each shard an --output folder of its own" in error_of(capsys)


def test_join_of_a_run_with_a_broken_image_ends_like_match(folder, shards, tmp_path):
    parts = copied(shards, tmp_path)
    images = tmp_path / "images"
    shutil.copytree(folder / "images", images)
    (images / "broken.jpg").write_bytes(b"no image")
    assert cli.run(["join", *parts, "--output", str(tmp_path / "out"), "--images", str(images)]) == SOME_FAILED


def test_shards_that_are_not_whole_are_named_with_the_mend(shards, tmp_path, capsys):
    output = ["--output", str(tmp_path / "out")]
    assert cli.run(["join", str(shards[1]), *output]) == ERROR
    assert "shards 1/3, 3/3 are missing; give the --output folders of all 3 shards" in error_of(capsys)
    parts = copied(shards, tmp_path)
    (tmp_path / "2" / "pairs" / f"{min(raw(shards[1]))}").unlink()
    assert cli.run(["join", *parts, *output]) == ERROR
    message = error_of(capsys)
    there = len(raw(shards[1]))
    assert f"shard 2/3 in '{tmp_path}/2' has {there - 1} of {there} blocks" in message
    assert f"start it again: `sgam-sfm match --config '{tmp_path}/2/options.json'`" in message
    (tmp_path / "3" / "inputs.json").unlink()
    assert cli.run(["join", *parts, *output]) == ERROR
    assert f"'{tmp_path}/3' has not got to its pairs yet; start it again" in error_of(capsys)
    assert not (tmp_path / "out" / "pairs").exists()


def test_folders_that_do_not_belong_together_are_refused(folder, whole, shards, matcher, tmp_path, capsys):
    output = ["--output", str(tmp_path / "out")]
    other = tmp_path / "other"
    match_collection(given(folder, other, shard="2/3", seed=7), point_matcher=matcher)
    assert cli.run(["join", str(shards[0]), str(other), *output]) == USAGE
    message = error_of(capsys)
    assert f"'{other}' was matched with other --seed (0 there, 7 here) than '{shards[0]}'; join shards of" in message
    fourth = tmp_path / "fourth"
    match_collection(given(folder, fourth, shard="4/40"), point_matcher=matcher)
    assert cli.run(["join", str(shards[0]), str(fourth), *output]) == USAGE
    assert f"'{fourth}' is shard 4/40 and '{shards[0]}' is 1/3; join shards of one run" in error_of(capsys)
    assert cli.run(["join", str(shards[0]), str(whole), *output]) == ERROR
    assert f"'{whole}' is not the output of a shard (it was matched without --shard); leave it out" in error_of(capsys)
    assert cli.run(["join", *map(str, shards), "--output", str(shards[1])]) == USAGE
    assert f"--output '{shards[1]}' is the folder of a shard; choose a new one for the whole run" in error_of(capsys)
    assert cli.run(["join", str(tmp_path / "nowhere"), *output]) == ERROR
    assert f"'{tmp_path}/nowhere' does not exist; give the --output folder of a match run" in error_of(capsys)
    assert cli.run(["join", *output]) == USAGE
    assert "no shard was given; give the --output folders of all shards of a run" in error_of(capsys)


def test_images_that_changed_since_the_shards_are_noticed(folder, shards, tmp_path, capsys):
    images = tmp_path / "images"
    shutil.copytree(folder / "images", images)
    changed = sorted(images.iterdir())[0]
    with changed.open("ab") as file:
        file.write(b"\0")
    output = tmp_path / "out"
    assert cli.run(["join", *map(str, shards), "--output", str(output), "--images", str(images)]) == ERROR
    told = f"the shards were matched with other images (1 with another content, '{changed.name}' for one); put back"
    assert told in error_of(capsys)
    assert not (output / "database.db").exists()


def test_labels_that_differ_between_shards_are_told(shards, tmp_path):
    parts = copied(shards, tmp_path)
    record = tmp_path / "3" / "labels" / "labels.json"
    record.write_text(record.read_text().replace('"share": 0', '"share": 1', 1))
    assert cli.run(["join", *parts, "--output", str(tmp_path / "out")]) == DONE
    told = (tmp_path / "out" / "log.txt").read_text()
    assert f"the label maps of '{tmp_path}/1' and '{tmp_path}/3' differ" in told
    assert f"'{tmp_path}/2' differ" not in told


@pytest.mark.parametrize("command", ["compare", "evaluate"])
@pytest.mark.parametrize("flag", [("--executor", "ray"), ("--shard", "1/2")])
def test_commands_of_one_process_refuse_machines(folder, tmp_path, capsys, command, flag):
    more = ["--methods", "sift"] if command == "compare" else ["--ground-truth", str(folder)]
    images = ["--images", str(folder / "images"), "--output", str(tmp_path)]
    assert cli.run([command, *images, *more, *flag]) == USAGE
    assert f"--executor ray and --shard are for `sgam-sfm match`; leave them out: {command} is one" in error_of(capsys)


def test_a_shard_that_is_none_is_one_line(folder, tmp_path, capsys):
    assert cli.run([*flags(given(folder, tmp_path)), "--shard", "0/4"]) == USAGE
    assert "--shard '0/4' is none; expected i/n with i from 1 to n, such as 1/4" in error_of(capsys)
    config = tmp_path / "config.toml"
    config.write_text('shard = "5"')
    assert cli.run([*flags(given(folder, tmp_path)), "--config", str(config)]) == USAGE
    assert "--shard '5' is none" in error_of(capsys)


def test_a_cluster_that_loses_a_machine_gives_what_one_process_gives(room, folder, tmp_path, monkeypatch):
    """Two machines with a core each; one dies in the middle, when it has a block."""
    pytest.importorskip("ray", reason="Ray is not installed: pip install 'sgam-sfm[ray]'")
    from ray._private.state import available_resources_per_node
    from ray.cluster_utils import Cluster

    monkeypatch.setenv("RAY_worker_niceness", "0")
    monkeypatch.setenv("RAY_USAGE_STATS_ENABLED", "0")
    write_pairs(tmp_path / "five.txt", combinations(sorted(room.images)[:5], 2))
    common = {"pairs": tmp_path / "five.txt", "area_matcher": "sgam", "matcher": "sift"}
    alone = given(folder, tmp_path / "alone", **common)
    assert cli.run(flags(alone)) == DONE
    quick = {"health_check_period_ms": 500, "health_check_failure_threshold": 3, "health_check_initial_delay_ms": 0}
    head = {"num_cpus": 1, "include_dashboard": False, "object_store_memory": 10**8, "_system_config": quick}
    cluster = Cluster(initialize_head=True, head_node_args=head)
    try:
        second = cluster.add_node(num_cpus=1, object_store_memory=10**8)
        address = {"executor": "ray", "ray_address": cluster.address}
        many = given(folder, tmp_path / "many", **common, **address)
        lost = threading.Event()

        def has_a_block() -> bool:
            return available_resources_per_node().get(second.node_id, {}).get("CPU", 0) == 0

        def lose() -> None:
            while not (list(many.output.glob("pairs/*.h5")) and has_a_block()):
                time.sleep(0.01)
            cluster.remove_node(second, allow_graceful=False)
            lost.set()

        threading.Thread(target=lose, daemon=True).start()
        assert cli.run(flags(many)) == DONE
        assert lost.is_set()
    finally:
        cluster.shutdown()
    assert raw(many.output) == raw(alone.output)
    assert database_content(many.output / "database.db") == database_content(alone.output / "database.db")
    log = (many.output / "log.txt").read_text()
    assert sum("pairs matched by" in line for line in log.splitlines()) == 10  # none twice
    summary = json.loads((many.output / "summary.json").read_text())
    assert sum(summary["executor"]["blocks_of_machines"].values()) == 10
