"""Blocks of pairs matched by the workers of a Ray cluster.

Each block is a Ray task that gets the cameras and files of its own images and reads those from the file system that all
machines share. Ray places tasks where there is a GPU, or cores, and runs those of a worker or machine that died again
elsewhere. The process that started the run takes the first result of each block, and it alone writes.
"""

from __future__ import annotations

import logging
import os
import socket
import time
from collections import Counter, deque
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any

from sgam_core import PointMatcher
from sgam_core.errors import InputError, OptionError, SGAMError, StageError
from sgam_sfm.executors import Begin, MatchingJob
from sgam_sfm.inputs import Inputs
from sgam_sfm.label_maps import LabelMaps
from sgam_sfm.machine import find_device, use_threads
from sgam_sfm.options import MatchOptions
from sgam_sfm.pairs import Pair, PairList
from sgam_sfm.runs.matching import CollectionMatcher, create_matcher, special_labels
from sgam_sfm.runs.store import PairRecord
from sgam_sfm.runs.summary import versions

_log = logging.getLogger(__name__)
_RETRIES = 5  # of a block whose worker died
_CONNECT_SECONDS = 5.0
_TICK_SECONDS = 1.0
_BLOCKS_PER_WORKER = 2  # handed out at a time: one to work on, one to begin with at once
_PATIENCE = 3.0  # times the longest turnaround so far, after which a block is a straggler
_MIN_PATIENCE_SECONDS = 60.0
_ENVIRONMENT = ("TORCH_HOME", "XDG_CACHE_HOME")  # where weights are looked for


@dataclass(frozen=True, kw_only=True, slots=True)
class Terms:
    """What all blocks are matched with: absolute paths; versions and environment of the process that started the run.

    threads: of each worker.
    """

    options: MatchOptions
    labels: LabelMaps | None
    threads: int
    versions: Mapping[str, str]
    environment: Mapping[str, str]


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Done:
    """A block's records, and who matched it: the address of a machine, and Ray's number of it."""

    records: Sequence[PairRecord]
    node: str


@contextmanager
def connected(options: MatchOptions) -> Iterator[RayExecutor]:
    """An executor on the cluster of the options, which is left at the end.

    Raises: OptionError when Ray is not installed, there is no such cluster, or none of its machines can run a worker.
    """
    try:
        import ray
    except ModuleNotFoundError as error:
        raise OptionError("--executor ray needs the package 'ray'; run `pip install 'sgam-sfm[ray]'`") from error
    ours = not ray.is_initialized()
    if ours:
        _connect(options.ray_address)
    try:
        device = _device(options.device, ray.cluster_resources())
        need = {"CPU": float(options.threads or 1)} | ({"GPU": 1.0} if device == "cuda" else {})
        _require_room(need)
        own_device = "cpu" if device == "cpu" else str(find_device("auto"))
        use_threads(options.threads)
        create_matcher(on_this_cpu(options))  # what is wrong with it is to be known before images are read
        yield RayExecutor(device=device, own_device=own_device, need=need)
    finally:
        if ours:
            ray.shutdown()


def on_this_cpu(options: MatchOptions) -> MatchOptions:
    """The options for a matcher that only the workers use, made here to see whether it can be made."""
    return replace(options, device="cpu", precision="auto" if options.precision == "auto" else "full")


def _connect(address: str) -> None:
    import ray

    if address.startswith("ray://"):
        raise OptionError(
            f"--ray-address '{address}' is for Ray's clients, which do not see the cluster's files; start the same "
            "command on one of its machines with --ray-address auto"
        )
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    alone = {"include_dashboard": False} if address == "local" else {}
    host, _, port = address.rpartition(":")
    try:
        if host and port.isdecimal():  # Ray itself tries for minutes
            socket.create_connection((host, int(port)), timeout=_CONNECT_SECONDS).close()
        ray.init(address=address, log_to_driver=False, logging_level=logging.ERROR, **alone)
    except (OSError, OverflowError, RuntimeError, ValueError, ray.exceptions.RayError) as error:
        reason = next(iter(str(error).splitlines()), type(error).__name__)
        raise OptionError(
            f"--ray-address '{address}': no Ray cluster can be reached ({reason}); start one with `ray start --head`, "
            "on the other machines `ray start --address HEAD:6379`, or use --ray-address local for this machine alone"
        ) from error


def _device(name: str, resources: Mapping[str, float]) -> str:
    """The torch device of the workers; Ray gives each its GPU.

    Raises: OptionError for a device that no worker can have.
    """
    has_gpu = resources.get("GPU", 0) >= 1
    if name == "auto":
        return "cuda" if has_gpu else "cpu"
    if name not in ("cpu", "cuda"):
        raise OptionError(f"--device '{name}' with --executor ray: Ray chooses the GPUs; give auto, cpu or cuda")
    if name == "cuda" and not has_gpu:
        raise OptionError(
            "--device cuda: no machine of the Ray cluster has a GPU; add one (`ray start --address HEAD:6379 "
            "--num-gpus 1`), or give --device cpu"
        )
    return name


def _require_room(need: Mapping[str, float]) -> None:
    """Refuse what would wait forever. Raises: OptionError when no machine has what one worker needs."""
    import ray

    machines = [node["Resources"] for node in ray.nodes() if node["Alive"]]
    if not any(_places(machine, need) for machine in machines):
        largest = max(machine.get("CPU", 0) for machine in machines)
        raise OptionError(
            f"--threads {need['CPU']:.0f}: no machine of the Ray cluster has {_told(need)}, as a worker needs "
            f"(the most cores are {largest:.0f}); give fewer --threads"
        )


def _places(machine: Mapping[str, float], need: Mapping[str, float]) -> int:
    """How many workers a machine has room for."""
    return int(min(machine.get(resource, 0) // amount for resource, amount in need.items()))


def _told(need: Mapping[str, float]) -> str:
    cores = f"{need['CPU']:.0f} core{'s' if need['CPU'] > 1 else ''}"
    return f"{cores} and a GPU" if "GPU" in need else cores


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class RayExecutor:
    """See `sgam_sfm.executors.Executor`. need: what one worker occupies of its machine, in Ray's resources."""

    device: str
    own_device: str
    need: Mapping[str, float]
    blocks_of: Counter[str] = field(default_factory=Counter)
    copies: Counter[int] = field(default_factory=Counter)

    def run(
        self, job: MatchingJob, blocks: Sequence[tuple[int, Sequence[Pair]]], begin: Begin
    ) -> Iterator[tuple[int, Sequence[PairRecord]]]:
        special_labels(job.options, job.labels)
        if not blocks:
            return
        content = dict(blocks)
        for number, done in self._results(job, content):
            self.blocks_of[done.node] += 1
            _log.info("block %d: %d pairs matched by %s", number, len(done.records), done.node)
            for record in done.records:
                if record.error:
                    _log.warning("%s - %s: %s", *record.pair, record.error)
            yield number, done.records

    def facts(self) -> dict[str, Any]:
        return {"name": "ray", "blocks_of_machines": dict(self.blocks_of), "copied_blocks": sorted(self.copies)}

    def _results(self, job: MatchingJob, blocks: Mapping[int, Sequence[Pair]]) -> Iterator[tuple[int, Done]]:
        """The result of every block, once. Raises: StageError for blocks that no worker survived, at the end."""
        import ray

        terms = ray.put(terms_of(job))
        resources = {"num_cpus": self.need["CPU"], "num_gpus": self.need.get("GPU", 0)}
        task = ray.remote(max_retries=_RETRIES, **resources)(match_block)
        waiting = deque(blocks)
        flights: dict[Any, Flight] = {}
        open_blocks = set(blocks)
        lost: dict[int, str] = {}
        longest, stranded = 0.0, False

        def send(number: int) -> None:
            block = blocks[number]
            flights[task.remote(terms, _part_of(job.inputs, block), block)] = Flight(number, time.monotonic())

        try:
            while open_blocks:
                places = self._places_now()
                if not places and not stranded:
                    _log.warning("no machine of the Ray cluster has room for a worker now; waiting for one")
                stranded = not places
                while waiting and len(flights) < _BLOCKS_PER_WORKER * max(places, 1):
                    send(waiting.popleft())
                ready, _ = ray.wait(list(flights), timeout=_TICK_SECONDS)
                for reference in ready:
                    flight = flights.pop(reference)
                    if flight.number not in open_blocks:
                        continue  # its copy was faster
                    try:
                        done: Done = ray.get(reference)
                    except ray.exceptions.RayError as error:
                        _raise_own(error)
                        if not any(other.number == flight.number for other in flights.values()):
                            lost[flight.number] = str(error).splitlines()[0]
                            open_blocks.remove(flight.number)
                        continue
                    open_blocks.remove(flight.number)
                    longest = max(longest, time.monotonic() - flight.sent)
                    yield flight.number, done
                if not waiting:
                    for number in overdue(flights.values(), open_blocks, longest, time.monotonic()):
                        _log.info("block %d takes long: another worker tries it too", number)
                        self.copies[number] += 1
                        send(number)
        finally:
            for reference in flights if ray.is_initialized() else ():
                ray.cancel(reference, force=True)
        if lost:
            number, reason = min(lost.items())
            first = " - ".join(blocks[number][0])
            raise StageError(
                f"{len(lost)} of {len(blocks)} blocks ended all {_RETRIES + 1} workers that tried them, such as "
                f"block {number} with the pair {first}: {reason}; all others are kept: start the same command again, "
                "with fewer workers on a machine if its memory was full"
            )

    def _places_now(self) -> int:
        """Workers that the cluster has room for; machines come and go."""
        import ray

        return sum(_places(node["Resources"], self.need) for node in ray.nodes() if node["Alive"])


@dataclass(frozen=True, slots=True)
class Flight:
    """A block that a worker has. sent: when, seconds of `time.monotonic`."""

    number: int
    sent: float


def overdue(flights: Collection[Flight], open_blocks: Collection[int], longest: float, now: float) -> list[int]:
    """Blocks that are out for much longer than any block took, and that only one worker has.

    Args: longest: seconds between the sending of a block and its result, the most so far (0: there is none yet).
    """
    if not longest:
        return []
    patience = max(_PATIENCE * longest, _MIN_PATIENCE_SECONDS)
    workers = Counter(flight.number for flight in flights)
    return sorted(
        flight.number
        for flight in flights
        if flight.number in open_blocks and workers[flight.number] == 1 and now - flight.sent > patience
    )


def _raise_own(error: Exception) -> None:
    """An exception of our code on a worker is raised here; the death of a worker is not."""
    import ray

    if isinstance(error, ray.exceptions.RayTaskError):
        if isinstance(error.cause, SGAMError):
            raise type(error.cause)(str(error.cause)) from None
        raise error


def terms_of(job: MatchingJob) -> Terms:
    """What all blocks have in common, for a process that works in another folder."""
    options, labels = job.options, job.labels
    paths = {name: getattr(options, name) for name in ("images", "output", "mask_path", "weights")}
    absolute = {name: path.absolute() for name, path in paths.items() if path is not None and path.exists()}
    return Terms(
        options=replace(options, **absolute),
        labels=None if labels is None else replace(labels, folder=labels.folder.absolute()),
        threads=options.threads or 1,
        versions=versions(),
        environment={name: os.environ[name] for name in _ENVIRONMENT if name in os.environ},
    )


def _part_of(inputs: Inputs, block: Sequence[Pair]) -> Inputs:
    """The inputs as far as a block is concerned."""
    names = sorted({name for pair in block for name in pair})
    files = {name: inputs.images[name] for name in names}
    return replace(
        inputs,
        images={name: replace(file, path=file.path.absolute()) for name, file in files.items()},
        cameras={name: inputs.cameras[name] for name in names},
        failed={},
        pairs=PairList(pairs=tuple(block)),
    )


def match_block(terms: Terms, inputs: Inputs, block: Sequence[Pair]) -> Done:
    """Match a block: what a worker does.

    Raises: InputError when this machine does not see the run's files, or has other versions of what results depend on.
    """
    import ray

    require_alike(terms)
    os.environ.update(terms.environment)
    use_threads(terms.threads)
    matcher = CollectionMatcher(terms.options, inputs, terms.labels, _point_matcher(terms.options))
    records = [record for _, record in matcher.match_blocks([(0, block)], lambda _: None)]
    return Done(records=records, node=f"{socket.gethostname()} ({ray.get_runtime_context().get_node_id()[:8]})")


def require_alike(terms: Terms) -> None:
    """Refuse to work on a machine that would give other results.

    Raises: InputError when it does not see the run's files, or has other versions of what results depend on.
    """
    here, host = _versions(), socket.gethostname()
    for package, version in terms.versions.items():
        if _release(here.get(package, "none")) != _release(version):
            raise InputError(
                f"the machine '{host}' of the Ray cluster has {package} {here.get(package, 'not installed')}, but the "
                f"one that started the run has {version}; install the same versions on all"
            )
    options = terms.options
    masks, weights = options.mask_path, options.weights
    folders = {"--images": options.images, "label maps": None if terms.labels is None else terms.labels.folder}
    for what, path in (folders | {"--mask-path": masks, "--weights": weights}).items():
        if path is not None and path.is_absolute() and not path.exists():
            raise InputError(
                f"the machine '{host}' of the Ray cluster does not see '{path}' ({what}); all machines must mount the "
                "images and --output under the same path"
            )


def _release(version: str) -> str:
    """A version without its build: torch has one for every kind of GPU."""
    return version.partition("+")[0]


_versions = lru_cache(maxsize=1)(versions)


@lru_cache(maxsize=1)
def _point_matcher(options: MatchOptions) -> PointMatcher:
    """The point matcher of a worker, which it keeps from block to block."""
    return create_matcher(options)
