"""What the Ray executor makes of a cluster's answers, told by a stand-in for Ray that keeps its own clock."""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from sgam_core.errors import InputError, OptionError, StageError
from sgam_sfm.colmap.cameras import CameraInfo
from sgam_sfm.executors import MatchingJob, open_executor, ray
from sgam_sfm.images import ImageFile
from sgam_sfm.inputs import Inputs
from sgam_sfm.options import MatchOptions
from sgam_sfm.pairs import Pair, PairList
from sgam_sfm.runs.store import PairRecord


class RayError(Exception):
    pass


class RayTaskError(RayError):
    def __init__(self, cause: Exception) -> None:
        super().__init__("a long text of the worker")
        self.cause = cause


Outcome = Callable[[Pair, int], "tuple[float, Exception | None]"]
"""Of a block with this pair, tried for the n-th time: the seconds it takes, and what it raises."""


class StandIn:
    """As much of Ray as the executor asks for."""

    def __init__(self, outcome: Outcome, **resources: float) -> None:
        self.exceptions = SimpleNamespace(RayError=RayError, RayTaskError=RayTaskError)
        self.outcome, self.resources = outcome, {"CPU": 2.0} | resources
        self.now = 0.0
        self.most_out = 0
        self.tries: Counter[Pair] = Counter()
        self.settings: dict[str, Any] = {}
        self.cancelled: list[Any] = []
        self.down = False

    def is_initialized(self) -> bool:
        return bool(self.settings) and not self.down

    def init(self, **settings: Any) -> None:
        self.settings = settings

    def shutdown(self) -> None:
        self.down = True

    def cluster_resources(self) -> dict[str, float]:
        return self.resources

    def nodes(self) -> list[dict[str, Any]]:
        return [{"Alive": True, "Resources": self.resources}, {"Alive": False, "Resources": {"CPU": 99.0}}]

    def put(self, value: Any) -> Any:
        return value

    def remote(self, **settings: Any) -> Callable:
        self.settings |= settings
        return lambda function: SimpleNamespace(remote=self._send)

    def _send(self, terms: ray.Terms, inputs: Inputs, block: tuple[Pair, ...]) -> Any:
        assert {name for pair in block for name in pair} == {*inputs.images} == {*inputs.cameras}
        self.tries[block[0]] += 1
        seconds, error = self.outcome(block[0], self.tries[block[0]])
        return _Reference(self.now + seconds, block, error)

    def wait(self, references: list[Any], timeout: float) -> tuple[list[Any], list[Any]]:
        self.most_out = max(self.most_out, len(references))
        self.now += timeout
        ready = [reference for reference in references if reference.ready <= self.now][:1]
        return ready, [reference for reference in references if reference not in ready]

    def get(self, reference: Any) -> ray.Done:
        if reference.error is not None:
            raise reference.error
        return ray.Done(records=[PairRecord(pair=pair, result=None, error="x") for pair in reference.block], node="n")

    def cancel(self, reference: Any, force: bool) -> None:
        self.cancelled.append(reference)


class _Reference:
    def __init__(self, ready: float, block: tuple[Pair, ...], error: Exception | None) -> None:
        self.ready, self.block, self.error = ready, block, error


PAIRS = tuple((f"{number}.jpg", f"{number + 1}.jpg") for number in range(12))


@pytest.fixture
def job(tmp_path) -> MatchingJob:
    names = [f"{number}.jpg" for number in range(13)]
    camera = {
        "image_id": 1,
        "camera_id": 1,
        "model": "PINHOLE",
        "params": (1.0, 1.0, 1.0, 1.0),
        "width": 4,
        "height": 3,
    }
    inputs = Inputs(
        images={name: ImageFile(name=name, path=Path(name), width=4, height=3, digest=name) for name in names},
        cameras={name: CameraInfo(**camera, has_prior_focal=False, known=False) for name in names},
        failed={},
        num_other_files=0,
        pairs=PairList(pairs=PAIRS),
    )
    options = MatchOptions(images=tmp_path, output=tmp_path / "out", executor="ray", device="cpu", matcher="sift")
    return MatchingJob(options=options, inputs=inputs, labels=None)


@pytest.fixture
def cluster(monkeypatch) -> Callable[..., StandIn]:
    def make(outcome: Outcome = lambda pair, attempt: (1.0, None), **resources: float) -> StandIn:
        made = StandIn(outcome, **resources)
        monkeypatch.setitem(sys.modules, "ray", made)
        monkeypatch.setattr(ray, "time", SimpleNamespace(monotonic=lambda: made.now))
        return made

    return make


def ignored(_: object) -> None:
    """Takes what a test does not look at."""


def run(job: MatchingJob, found: list[int] | None = None) -> list[int]:
    """The numbers of the blocks, in the order in which they came back."""
    found = [] if found is None else found
    with open_executor(job.options) as executor:
        for number, records in executor.run(job, [(7 + n, (pair,)) for n, pair in enumerate(PAIRS)], ignored):
            assert [record.pair for record in records] == [PAIRS[number - 7]]
            found.append(number)
    return found


def test_every_block_comes_back_once_in_the_order_of_the_workers(job, cluster):
    stand_in = cluster(lambda pair, attempt: (5.0 if pair == PAIRS[0] else 1.0, None))
    found = run(job)
    assert sorted(found) == list(range(7, 19))
    assert found[0] == 8  # the first block was slower
    assert set(stand_in.tries.values()) == {1}
    assert stand_in.most_out == 4  # two for each of two cores, however many wait
    assert stand_in.settings["max_retries"] > 0
    assert (stand_in.settings["num_cpus"], stand_in.settings["num_gpus"]) == (1, 0)
    assert stand_in.down


def test_a_straggler_is_given_to_another_worker_and_the_first_result_counts(job, cluster):
    stand_in = cluster(lambda pair, attempt: (1e6 if (pair, attempt) == (PAIRS[3], 1) else 1.0, None))
    assert sorted(run(job)) == list(range(7, 19))
    assert stand_in.tries[PAIRS[3]] == 2
    assert stand_in.now < 300
    assert [reference.block for reference in stand_in.cancelled] == [(PAIRS[3],)]


def test_the_slower_of_two_results_is_not_counted_again(job, cluster):
    """The copy comes back after the first worker, while another block is still out."""
    seconds = {(PAIRS[3], 1): 70.0, (PAIRS[3], 2): 20.0, (PAIRS[4], 1): 100.0, (PAIRS[4], 2): 100.0}
    cluster(lambda pair, attempt: (seconds.get((pair, attempt), 1.0), None))
    assert sorted(run(job)) == list(range(7, 19))


def test_blocks_are_not_copied_before_their_time():
    flights = [ray.Flight(1, 0.0), ray.Flight(2, 50.0), ray.Flight(3, 0.0), ray.Flight(3, 60.0), ray.Flight(4, 0.0)]
    assert ray.overdue(flights, {1, 2, 3}, 10.0, 70.0) == [1]  # 2 is young, 3 has two workers, 4 is done
    assert ray.overdue(flights, {1, 2, 3}, 30.0, 70.0) == []  # others took half as long
    assert ray.overdue(flights, {1, 2, 3}, 0.0, 1e6) == []  # nothing is known yet


def test_a_block_that_ends_its_workers_is_named_once_all_others_are_done(job, cluster):
    cluster(lambda pair, attempt: (1.0, RayError("worker died\nof something") if pair == PAIRS[2] else None))
    found: list[int] = []
    expected = (
        r"1 of 12 blocks ended all 6 workers .* block 9 with the pair 2\.jpg - 3\.jpg: worker died; all others are "
        "kept: start the same command again"
    )
    with pytest.raises(StageError, match=expected):
        run(job, found)
    assert sorted(found) == [number for number in range(7, 19) if number != 9]


def test_what_a_worker_refuses_is_told_as_it_said_it_and_others_are_stopped(job, cluster):
    stand_in = cluster(lambda pair, attempt: (1.0, RayTaskError(InputError("no images on 'node7'"))))
    with pytest.raises(InputError, match=r"^no images on 'node7'$"):
        run(job)
    assert len(stand_in.cancelled) == 3
    assert stand_in.down


def test_a_mistake_of_ours_on_a_worker_keeps_its_traceback(job, cluster):
    cluster(lambda pair, attempt: (1.0, RayTaskError(KeyError("x"))))
    with pytest.raises(RayTaskError, match="a long text of the worker"):
        run(job)


def test_workers_take_a_gpu_each_where_there_are_any(job, cluster):
    stand_in = cluster(GPU=1.0)
    options = replace(job.options, device="auto", threads=2)
    with open_executor(options) as executor:
        assert (executor.device, executor.own_device) == ("cuda", "cpu")
        assert len(list(executor.run(job, [(0, (PAIRS[0],)), (1, (PAIRS[1],)), (2, (PAIRS[2],))], ignored))) == 3
    assert (stand_in.settings["num_cpus"], stand_in.settings["num_gpus"]) == (2, 1)
    assert stand_in.most_out == 2


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        (
            {"device": "cuda"},
            r"--device cuda: no machine of the Ray cluster has a GPU; add one .* or give --device cpu",
        ),
        ({"device": "cuda:1"}, "--device 'cuda:1' with --executor ray: Ray chooses the GPUs; give auto, cpu or cuda"),
        ({"threads": 8}, r"--threads 8: .* 8 cores, as a worker needs \(the most cores are 2\); give fewer --threads"),
        ({"ray_address": "ray://head:10001"}, r"--ray-address 'ray://head:10001' is for Ray's clients.* --ray-address"),
        ({"matcher": "sitf"}, "--matcher 'sitf' is unknown; did you mean 'sift'"),
    ],
)
def test_what_no_cluster_can_do_is_refused_at_once(job, cluster, changes, expected):
    cluster()
    with pytest.raises(OptionError, match=expected), open_executor(replace(job.options, **changes)):
        pass


def test_a_cluster_that_is_not_there(job, cluster, monkeypatch):
    stand_in = cluster()

    def refuse(**settings: Any) -> None:
        raise ConnectionError("Could not find any running Ray instance.\nMore.")

    monkeypatch.setattr(stand_in, "init", refuse)
    expected = r"--ray-address 'auto': no Ray cluster can be reached \(Could not .* instance.\); .* `ray start --head`"
    with pytest.raises(OptionError, match=expected), open_executor(job.options):
        pass


@pytest.mark.parametrize("address", ["127.0.0.1:1", "127.0.0.1:99999"])
def test_a_head_that_does_not_answer_is_told_at_once(job, cluster, address):
    stand_in = cluster()
    expected = rf"--ray-address '{address}': no Ray cluster can be reached \(.+\); start one with"
    with pytest.raises(OptionError, match=expected), open_executor(replace(job.options, ray_address=address)):
        pass
    assert not stand_in.settings


def test_without_ray_the_extra_is_named(job, monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with (
        pytest.raises(OptionError, match=r"--executor ray needs .*; run `pip install 'sgam-sfm\[ray\]'`"),
        open_executor(job.options),
    ):
        pass


def test_a_machine_that_does_not_see_the_images_or_has_other_packages_is_named(job):
    terms = ray.terms_of(job)
    ray.require_alike(terms)
    away = replace(terms, options=replace(terms.options, images=Path("/nowhere/images")))
    with pytest.raises(InputError, match=r"does not see '/nowhere/images' \(--images\); all machines must mount"):
        ray.require_alike(away)
    torch = terms.versions["torch"].partition("+")[0]
    ray.require_alike(replace(terms, versions=terms.versions | {"torch": f"{torch}+cu128"}))
    with pytest.raises(InputError, match=rf"has torch {torch}.*, but the one that started the run has 1\.0; install"):
        ray.require_alike(replace(terms, versions=terms.versions | {"torch": "1.0"}))
