"""Workers in processes of their own: what they give, and what is told of those that fail."""

import logging
import sys
import textwrap
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import PIL.Image
import psutil
import pytest

from sgam_core.errors import InputError, OptionError, StageError
from sgam_core.types import Crop
from sgam_sfm import cli
from sgam_sfm.exit_codes import DONE, ERROR, USAGE
from sgam_sfm.external import WorkerCommand, WorkerError
from sgam_sfm.images import ImageFile, inspect_image
from sgam_sfm.matchers.external import ExternalMatcher
from sgam_sfm.matchers.vismatch import vismatch
from sgam_sfm.options import MatchOptions, fingerprint, starting_options
from sgam_sfm.runs.matching import create_matcher
from sgam_sfm.segmenters.external import ExternalSegmenter
from tests.textures import similarity, view, whole

SIFT = Path(__file__).parents[1] / "workers" / "sift_worker.py"
CENTERS = """
    def match(pairs):  # the centre of the first pixel, and of the last one
        return [
            (np.array([[0, 0], [a.shape[1] - 1, a.shape[0] - 1]]), np.array([[0, 0], [b.shape[1] - 1, b.shape[0] - 1]]),
             None) for a, b in pairs
        ]
"""


@pytest.fixture
def write(tmp_path):
    """Writes a worker: the lines of `load`, what it serves, and what stands before it."""

    def make(body: str = CENTERS, serve: str = 'serve_matcher(load, origin="center")', before: str = "") -> Path:
        script = tmp_path / f"worker{len(list(tmp_path.iterdir()))}.py"
        imports = "import os, sys, time\nimport numpy as np\nfrom sgam_worker import serve_matcher, serve_segmenter\n"
        returned = "segment" if "def segment" in body else "match"
        load = f"def load(settings):\n{textwrap.indent(textwrap.dedent(body), '    ')}\n    return {returned}\n"
        script.write_text(f"{imports}{textwrap.dedent(before)}\n{load}\n{serve}\n")
        return script

    return make


def command(script: Path | None, kind: str = "matcher", **changes: object) -> WorkerCommand:
    return WorkerCommand(**{"kind": kind, "name": "external", "script": script, "timeout": 60.0, **changes})


@pytest.fixture
def open_matcher():
    """Starts matchers, which end with the test."""
    opened: list[ExternalMatcher] = []

    def start(script: Path | None, weights: Path | None = None, **changes: object) -> ExternalMatcher:
        opened.append(ExternalMatcher(worker=command(script, **changes), weights=weights, seed=7))
        return opened[-1]

    yield start
    for matcher in opened:
        matcher.close()


def crop(width: int = 40, height: int = 30, name: str = "image", mask: np.ndarray | None = None) -> Crop:
    return whole(np.full((height, width, 3), 128, np.uint8), name, mask)


PAIR = (crop(), crop(20, 50, "other"))


def rejected(script: Path | None, **changes: object) -> str:
    with pytest.raises((InputError, OptionError, StageError)) as error:
        ExternalMatcher(worker=command(script, **changes))
    return str(error.value)


def fails(matcher: ExternalMatcher, expected: type[Exception] = StageError) -> str:
    with pytest.raises(expected) as error:
        matcher.match([PAIR])
    return str(error.value)


def test_points_come_back_in_order_and_in_corner_origin(write, open_matcher):
    third = crop(8, 8, "third")
    matches = open_matcher(write()).match([PAIR, (third, PAIR[0]), PAIR])
    assert [found.points0.tolist() for found in matches] == [
        [[0.5, 0.5], [39.5, 29.5]],
        [[0.5, 0.5], [7.5, 7.5]],
        [[0.5, 0.5], [39.5, 29.5]],
    ]
    assert matches[0].points1.tolist() == [[0.5, 0.5], [19.5, 49.5]]
    assert matches[0].scores.tolist() == [1, 1]
    corner = open_matcher(write(serve='serve_matcher(load, origin="corner")'))
    assert corner.match([PAIR])[0].points0[0].tolist() == [0, 0]


def test_crops_come_as_they_are_and_large_lists_in_parts(write, open_matcher, monkeypatch):
    script = write("""
        def match(pairs):
            return [([[a[0, 1, 0], len(pairs)]], [[b[1, 0, 2], 0]], [a.mean() / 255]) for a, b in pairs]
    """)
    pixels = np.random.default_rng(0).integers(0, 40, (64, 64, 3), np.uint8)
    one, other = whole(pixels, "one"), whole(pixels[::-1].copy(), "other")
    monkeypatch.setattr("sgam_sfm.matchers.external._MESSAGE_BYTES", 5 * pixels.nbytes)
    found = open_matcher(script).match([(one, other)] * 3)
    assert [matches.points0[0].tolist() for matches in found] == [
        [pixels[0, 1, 0] + 0.5, count + 0.5] for count in (2, 2, 1)
    ]
    assert found[0].points1[0, 0] == pixels[::-1][1, 0, 2] + 0.5
    assert found[0].scores[0] == pytest.approx(pixels.mean() / 255)


def test_masked_points_are_dropped(write, open_matcher):
    mask = np.ones((30, 40), bool)
    mask[-1, -1] = False
    (matches,) = open_matcher(write()).match([(crop(mask=mask), PAIR[1])])
    assert matches.points0.tolist() == [[0.5, 0.5]]


def test_points_outside_are_dropped_and_told_once(write, open_matcher, caplog):
    matcher = open_matcher(
        write("""
            def match(pairs):
                return [([[0, 0], [80, 60], [39.8, 3]], [[0, 0], [5, 5], [5, 5]], None) for pair in pairs]
        """)
    )
    with caplog.at_level(logging.WARNING):
        assert [len(found) for found in matcher.match([PAIR, PAIR])] == [1, 1]  # 39.8 + 0.5 is outside, by rounding
    (record,) = caplog.records
    assert record.message == (
        "1 of 3 points of a worker lie outside their crop, which is 40 x 30, for example (80.5, 60.5), and are "
        "dropped; the script must give pixels of the images that it is sent, not of resized ones"
    )


def test_settings_and_arguments_reach_the_script(write, open_matcher, tmp_path):
    (tmp_path / "beside.py").write_text("FOUND = True\n")
    weights = tmp_path / "w.pt"
    weights.touch()
    script = write(
        f"assert beside.FOUND\nassert sys.argv[1:] == ['a', 'b c'], sys.argv\n"
        f"assert vars(settings) == dict(device='cpu', weights={str(weights)!r}, seed=7, threads=3), settings\n"
        + textwrap.dedent(CENTERS),
        before="import beside",
    )
    matcher = open_matcher(script, weights, arguments=("a", "b c"), threads=3)
    assert len(matcher.match([PAIR])[0]) == 2


def test_what_a_script_prints_is_log_and_not_answer(write, open_matcher, caplog):
    script = write(
        "print('loading')\nos.write(1, b'raw bytes\\n')\n" + textwrap.dedent(CENTERS), before="print('SGAM before')"
    )
    with caplog.at_level(logging.INFO):
        matcher = open_matcher(script)
        assert len(matcher.match([PAIR])[0]) == 2
        matcher.close()
    assert {"worker: SGAM before", "worker: loading", "worker: raw bytes"} <= {
        record.message for record in caplog.records
    }


def test_packages_of_this_environment_are_out_of_reach(write, monkeypatch, tmp_path):
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    (tmp_path / "of_ours.py").touch()
    script = tmp_path / "elsewhere" / "worker.py"
    script.parent.mkdir()
    write("import of_ours\n" + textwrap.dedent(CENTERS)).rename(script)
    assert "could not load its model: ModuleNotFoundError: No module named 'of_ours'" in rejected(script)


def test_a_crash_is_mended_by_one_new_start(write, open_matcher, tmp_path, caplog):
    body = f"""
        def match(pairs):
            if not os.path.exists({str(tmp_path / "crashed")!r}):
                open({str(tmp_path / "crashed")!r}, "w").close()
                os._exit(3)
            return [([[1, 1]], [[2, 2]], [0.5])]
    """
    matcher = open_matcher(write(body))
    with caplog.at_level(logging.WARNING):
        assert len(matcher.match([PAIR])[0]) == 1
    assert caplog.records[0].message.endswith("ended with exit code 3; it is started again")


def test_a_crash_twice_is_told_with_the_last_lines(write, open_matcher):
    script = write("""
        def match(pairs):
            print("about to read memory that is not there")
            os.kill(os.getpid(), 11)
    """)
    message = fails(open_matcher(script))
    assert message.startswith(
        f"--matcher external ('{script}') was ended by signal 11 (Segmentation fault), and did so twice for the same "
        "pairs; what is done is kept: mend the worker, then start the same command again; its last lines:\n"
    )
    assert "\n  about to read memory that is not there\n" in message
    assert "in match" in message  # where, by faulthandler


def test_a_worker_that_hangs_is_ended_with_all_it_started(write, open_matcher, tmp_path, caplog):
    script = write(f"""
        def match(pairs):
            if not os.path.exists({str(tmp_path / "child")!r}):
                import subprocess
                child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(600)"])
                open({str(tmp_path / "child")!r}, "w").write(str(child.pid))
                time.sleep(600)
            return [([[1, 1]], [[2, 2]], [0.5])]
    """)
    with caplog.at_level(logging.WARNING):
        assert len(open_matcher(script, timeout=4.0).match([PAIR])[0]) == 1
    assert caplog.records[0].message.endswith("did not answer within 4 s (--worker-timeout); it is started again")
    child = int((tmp_path / "child").read_text())
    assert not psutil.pid_exists(child) or psutil.Process(child).status() == psutil.STATUS_ZOMBIE


def test_the_wrong_version_of_the_protocol(write):
    script = write(before="import sgam_worker\nsgam_worker.PROTOCOL = 99")
    message = rejected(script)
    assert (
        "speaks version 99 of the protocol, this sgam-sfm version 1; let the script use the sgam_worker.py" in message
    )


def test_garbage_before_the_protocol(tmp_path, write):
    python = tmp_path / "python"
    python.write_text(f'#!/bin/sh\necho "Activating the environment"\nexec "{sys.executable}" "$@"\n')
    python.chmod(0o755)
    message = rejected(write(), python=python)
    assert "sent what is no message of the protocol (expected a message, got b'Activati')" in message
    assert "nothing else may print where its Python starts" in message


def test_a_script_that_breaks_or_ends_before_it_serves(write):
    assert "came to serve_matcher; its last lines:\n" in (message := rejected(write(before="1 / 0")))
    assert "ended with exit code 1 before it" in message
    assert message.endswith("ZeroDivisionError: division by zero")
    assert rejected(write(serve="")).endswith("ended with exit code 0 before it came to serve_matcher")
    assert "could not load its model: ValueError: no weights" in rejected(write("raise ValueError('no weights')"))


def test_a_segmenter_is_no_matcher(write):
    body = "def segment(image):\n    return 0"
    assert rejected(write(body, "serve_segmenter(load)")).endswith(
        "is a segmenter; give it by --segmenter external --segmenter-script"
    )


def test_the_origin_must_be_said(write):
    message = rejected(write(serve='serve_matcher(load, origin="middle")'))
    assert "says that the origin of its points is 'middle'; expected 'corner', where the centre of the first" in message


def test_what_cannot_be_started(tmp_path, write):
    script = write()
    assert rejected(None).startswith("--matcher external needs --matcher-script FILE, the worker; docs/workers.md")
    assert rejected(tmp_path / "no.py") == (
        f"--matcher-script '{tmp_path / 'no.py'}' does not exist; give the worker, a Python script"
    )
    assert rejected(script, python=tmp_path / "python") == (
        f"--matcher-python '{tmp_path / 'python'}' does not exist; give the Python of the worker's environment, such "
        "as /path/env/bin/python"
    )
    assert f"--matcher-python '{tmp_path}' is a folder; give" in rejected(script, python=tmp_path)
    assert f"--matcher-python '{script}' cannot be run (Permission denied); give" in rejected(script, python=script)
    assert rejected(script, timeout=0.0) == "--worker-timeout is 0; expected more than 0 seconds"


WRONG = {
    "shapes": (
        "[(np.zeros((2, 3)), np.zeros((2, 3)), [1, 1])]",
        "points0, points1, scores of shapes (2, 3), (2, 3), (2,)",
    ),
    "lengths": (
        "[(np.zeros((2, 2)), np.zeros((1, 2)), None)]",
        "points0, points1, scores of shapes (2, 2), (1, 2), (2,)",
    ),
    "nan": (
        "[([[np.nan, 1]], [[1, 1]], None)]",
        "points or scores that are not finite; let the script drop these matches",
    ),
    "scores": ("[([[1, 1]], [[1, 1]], [7.5])]", "scores from 7.5 to 7.5; expected [0, 1]: let the script scale them"),
    "count": ("[]", "0 arrays for 1 pairs; expected 3 for each"),
}


@pytest.mark.parametrize("case", WRONG)
def test_wrong_results_end_the_run_when_they_are_the_first(write, open_matcher, case):
    result, expected = WRONG[case]
    message = fails(open_matcher(write(f"def match(pairs):\n    return {result}")))
    assert f"gave {expected}" in message


def test_an_error_is_that_of_one_pair_once_others_went_well(write, open_matcher):
    script = write("""
        def match(pairs):
            if pairs[0][0].shape[0] == 7:
                raise MemoryError("no room for this one")
            return [([[1, 1]], [[2, 2]], None)]
    """)
    odd = (crop(7, 7, "odd"), PAIR[1])
    matcher = open_matcher(script)
    with pytest.raises(StageError, match="failed: MemoryError: no room for this one; its last lines:"):
        matcher.match([odd])
    matcher = open_matcher(script)
    matcher.match([PAIR])
    with pytest.raises(WorkerError, match=r"failed: MemoryError: no room for this one$"):
        matcher.match([odd])
    assert len(matcher.match([PAIR])[0]) == 1


def test_a_worker_ends_with_its_matcher(write, open_matcher):
    before = set(psutil.Process().children())  # those of other tests' libraries too
    matcher = open_matcher(write("def match(pairs):\n    return [([[os.getpid() % 39, 0]], [[0, 0]], None)]"))
    (child,) = set(psutil.Process().children()) - before
    del matcher
    assert child.is_running()  # the fixture still has it
    open_matcher.__closure__[0].cell_contents.clear()
    assert not psutil.pid_exists(child.pid)


# Segmenters


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Two views of the texture."""
    folder = tmp_path_factory.mktemp("images")
    for name, warp in (("view0.png", np.eye(3)), ("view1.png", similarity(1.1, 6, (7.3, -4.6), (160, 120)))):
        PIL.Image.fromarray(view(warp, (320, 240))).save(folder / name)
    return folder


@pytest.fixture
def images(folder) -> list[ImageFile]:
    return [inspect_image(folder, name) for name in ("view0.png", "view1.png")]


THIRDS = """
    def segment(image):
        labels = np.ones(image.shape[:2], int)
        labels[:, image.shape[1] // 3 :] = 300
        return labels[::2, ::2]
"""


def test_label_maps_and_names_of_a_segmenter(write, images):
    script = write(THIRDS, 'serve_segmenter(load, labels={1: "left", 300: "right"})')
    with closing(ExternalSegmenter(worker=command(script, "segmenter"))) as segmenter:
        gone = replace(images[0], path=images[0].path.with_name("gone.png"))
        results = [labels for _, labels in segmenter.segment([gone, images[1]], lambda share: None)]
        assert {label.name: label.id for label in segmenter.label_set.labels} == {"left": 1, "right": 300}
    assert "cannot be read" in str(results[0])
    height, width = images[1].height, images[1].width
    assert results[1].dtype == np.int32
    assert results[1].shape == ((height + 1) // 2, (width + 1) // 2)
    assert np.unique(results[1]).tolist() == [1, 300]


WRONG_MAPS = {
    "aspect": ("np.zeros((50, 200), int)", "gave int32 (50, 200) for 'view"),
    "floats": ("np.zeros((5, 5))", "failed: TypeError: labels are float64; expected integers"),
    "negative": ("np.full(image.shape[:2], -1)", "gave ids from -1 to -1 for 'view"),
    "pictures": ("image", "for 'view"),
}


@pytest.mark.parametrize("case", WRONG_MAPS)
def test_wrong_label_maps(write, images, case):
    made, expected = WRONG_MAPS[case]
    script = write(f"def segment(image):\n    return {made}", "serve_segmenter(load)")
    segmenter = ExternalSegmenter(worker=command(script, "segmenter"))
    with closing(segmenter), pytest.raises(StageError) as error:
        list(segmenter.segment(images, lambda share: None))
    assert f"--segmenter external ('{script}') " in str(error.value)
    assert expected in str(error.value)


def test_names_of_labels_must_be_by_id(write):
    script = write(THIRDS, 'serve_segmenter(load, labels={"left": 1})')
    with pytest.raises(StageError, match=r"has labels that are no names by id; expected \{1: 'wall', ...\}"):
        ExternalSegmenter(worker=command(script, "segmenter"))


# Whole runs


def test_a_run_with_two_workers_resumes_only_with_the_same(folder, other_python, write, tmp_path, capsys):
    segmenter = write(THIRDS, 'serve_segmenter(load, labels={1: "left"})')
    matcher = tmp_path / "matcher.py"
    matcher.write_text(SIFT.read_text())
    given = [
        *("match", "--images", str(folder), "--output", str(tmp_path / "out"), "--no-mapping"),
        *("--matcher", "external", "--matcher-script", str(matcher), "--matcher-python", str(other_python)),
        *("--segmenter", "external", "--segmenter-script", str(segmenter)),
    ]
    assert cli.run(given) == DONE
    assert "left" in (tmp_path / "out/labels/labels.json").read_text()
    assert starting_options(tmp_path / "out/options.json", None).matcher_script == matcher
    matcher.write_text(SIFT.read_text() + "# another one\n")
    assert cli.run(given) == USAGE
    assert "was begun with other content of --matcher-script; choose" in capsys.readouterr().err


def test_a_worker_that_gives_up_ends_the_run_and_not_only_its_pairs(folder, write, tmp_path, capsys):
    given = [
        *("match", "--images", str(folder), "--area-matcher", "none"),
        *("--output", str(tmp_path / "out"), "--no-mapping", "--matcher", "external", "--matcher-script"),
    ]
    assert cli.run([*given, str(write("def match(pairs):\n    os._exit(9)"))]) == ERROR
    assert "ended with exit code 9, and did so twice" in capsys.readouterr().err
    assert not list((tmp_path / "out/pairs").glob("*.h5"))


def test_a_script_that_nothing_runs_is_refused(tmp_path, capsys):
    given = ["match", "--images", str(tmp_path), "--output", str(tmp_path / "out"), "--matcher-script", "x.py"]
    assert cli.run(given) == USAGE
    assert (
        "--matcher-script would not be used by --matcher xfeat-star; add `--matcher external`"
        in capsys.readouterr().err
    )


def test_the_content_of_a_script_is_part_of_the_fingerprint(tmp_path):
    script = tmp_path / "worker.py"
    script.write_text("1")
    options = MatchOptions(images=Path(), output=Path(), matcher="external", matcher_script=script)
    before = fingerprint(options)
    assert fingerprint(replace(options, worker_timeout=9.0)) == before
    assert fingerprint(replace(options, matcher_args="x")) != before
    assert fingerprint(replace(options, matcher_python=Path("/other/bin/python"))) != before
    script.write_text("2")
    assert fingerprint(options) != before


def test_arguments_are_quoted_as_in_a_shell():
    options = MatchOptions(images=Path(), output=Path(), matcher="external", matcher_args="a 'b c'")
    assert WorkerCommand.of(options, "matcher", "external").arguments == ("a", "b c")
    with pytest.raises(
        OptionError, match=r"--matcher-args cannot be split \(No closing quotation\); quote as in a shell"
    ):
        WorkerCommand.of(replace(options, matcher_args="'a"), "matcher", "external")


def test_a_name_after_a_colon_is_for_models_that_take_one():
    with pytest.raises(OptionError, match="--matcher 'sift:fine': 'sift' is one model; give --matcher sift"):
        create_matcher(MatchOptions(images=Path(), output=Path(), matcher="sift:fine"))
    with pytest.raises(OptionError, match="--matcher 'sfit:fine' is unknown; did you mean"):
        create_matcher(MatchOptions(images=Path(), output=Path(), matcher="sfit:fine"))


# vismatch


def test_vismatch_without_an_environment_tells_how_to_make_it(tmp_path, monkeypatch):
    monkeypatch.setenv("SGAM_SFM_VISMATCH", str(tmp_path / "env"))
    options = MatchOptions(images=Path(), output=Path(), matcher="vismatch:sift-nn")
    with pytest.raises(OptionError) as error:
        create_matcher(options)
    assert str(error.value) == (
        f"--matcher vismatch:sift-nn needs vismatch in an environment of its own, which is not in '{tmp_path}/env'; "
        f"make it with `python3 -m venv '{tmp_path}/env' && '{tmp_path}/env/bin/python' -m pip install vismatch`, or "
        "name another one by --matcher-python or SGAM_SFM_VISMATCH"
    )


@pytest.mark.parametrize("name", ["superglue", "superpoint-lightglue", "minima-superpoint-lightglue", "master", "r2d2"])
def test_vismatch_asks_for_licences_that_forbid_commercial_use(name):
    options = MatchOptions(images=Path(), output=Path(), matcher=f"vismatch:{name}")
    with pytest.raises(OptionError, match=f"may not be used commercially.*add `--accept-licence vismatch:{name}`$"):
        create_matcher(options)


def test_vismatch_needs_a_name_and_no_weights(tmp_path):
    with pytest.raises(OptionError, match="--matcher vismatch needs a name: vismatch:loftr"):
        vismatch(worker=command(None))
    with pytest.raises(OptionError, match="vismatch finds its own; leave it out"):
        vismatch(worker=command(None), name="loftr", weights=tmp_path)


def test_vismatch_is_run_by_its_name(tmp_path, monkeypatch, caplog):
    """Against a package of the same interface, since the real one brings gigabytes."""
    packages, python = tmp_path / "packages", tmp_path / "env" / "bin" / "python"
    packages.mkdir()
    (packages / "torch.py").write_text("def manual_seed(seed): pass\n")
    (packages / "vismatch.py").write_text(
        textwrap.dedent("""
        import numpy as np

        def get_matcher(name, device, **options):
            def model(image0, image1):
                assert (name, device, options) == ("toy-roma", "cpu", {"max_num_keypoints": 9})
                assert image0.dtype == np.float32 and image0.shape[0] == 3 and image0.max() <= 1
                if image0.max() == 0:
                    raise RuntimeError("no keypoints")
                points = np.array([[1.0, 2.0]])
                return {"matched_kpts0": points, "matched_kpts1": points + 1, "matched_confidences": np.array([1.5])}
            return model
    """)
    )
    python.parent.mkdir(parents=True)
    python.write_text(f'#!/bin/sh\nPYTHONPATH="{packages}" exec "{sys.executable}" "$@"\n')
    python.chmod(0o755)
    monkeypatch.setenv("SGAM_SFM_VISMATCH", str(tmp_path / "env"))
    options = MatchOptions(
        images=Path(), output=Path(), matcher="vismatch:toy-roma", matcher_args="9", device="cpu", threads=0
    )
    matcher = create_matcher(options)
    with closing(matcher):
        black = whole(np.zeros((30, 40, 3), np.uint8), "black")
        found, nothing = matcher.match([PAIR, (black, PAIR[1])])
    assert (found.points0.tolist(), found.points1.tolist(), found.scores.tolist()) == ([[1, 2]], [[2, 3]], [1])
    assert len(nothing) == 0
    assert "loads its code and weights itself" in caplog.text
