"""No file that a user could have been given is read in a way that could run what it carries."""

from __future__ import annotations

import ast
from pathlib import Path

import sgam_core
import sgam_sfm

# It refuses every name but those of plain arrays; see its tests.
RESTRICTED = "npz_objects.py"


def problems(path: Path) -> list[str]:
    found = []
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import | ast.ImportFrom):
            names = {name.name.partition(".")[0] for name in node.names} | {str(getattr(node, "module", ""))}
            if names & {"pickle", "cPickle", "dill", "joblib", "marshal", "shelve", "yaml"} and path.name != RESTRICTED:
                found.append(f"{path.name}:{node.lineno} imports {names}")
        if isinstance(node, ast.Call):
            name, options = ast.unparse(node.func), {option.arg: option.value for option in node.keywords}
            given = {key: getattr(value, "value", None) for key, value in options.items()}
            if name in ("eval", "exec") or given.get("allow_pickle"):
                found.append(f"{path.name}:{node.lineno} {name}")
            if name == "torch.load" and given.get("weights_only") is not True:
                found.append(f"{path.name}:{node.lineno} torch.load without weights_only=True")
    return found


def test_nothing_is_unpickled_or_evaluated():
    files = [path for package in (sgam_core, sgam_sfm) for path in Path(package.__file__).parent.rglob("*.py")]
    assert len(files) > 100
    assert [problem for path in files for problem in problems(path)] == []


def test_the_search_finds_what_it_looks_for(tmp_path):
    path = tmp_path / "bad.py"
    path.write_text("import pickle\nnp.load(a, allow_pickle=True)\ntorch.load(a)\neval(b)\n")
    assert len(problems(path)) == 4
