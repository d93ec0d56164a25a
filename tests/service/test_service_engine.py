from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import islice, zip_longest
from pathlib import Path

import numpy as np
import onnxruntime as ort
import pytest
from threaded import run_by_threads
from tiny_bundles import NUM_STEPS, X_T_SHAPE, walking

from models.bundle import read_manifest
from models.diffusion import ddim_step
from service.engine.context import Part, Tensors
from service.engine.engine import Engine, predict
from service.engine.runner import Runner
from service.engine.trajectory import Failure, Preview, Request, Result
from service.errors import FieldError, GraphError, NonFiniteError

WALK = walking().astype(np.float32)
TOO_FAST = walking(speed=99.0).astype(np.float32)


def engine_of(folder: Path, rows_per_step: int = 64) -> Engine:
    return Engine(Runner(read_manifest(folder), folder, threads=1), rows_per_step=rows_per_step)


def request(seed: int = 0, num_samples: int = 3, **options: object) -> Request:
    return Request(observation=WALK, num_samples=num_samples, seed=seed, **options)  # type: ignore[arg-type]


def futures(engine: Engine, request: Request) -> np.ndarray:
    return predict(engine, request).futures


def early(num_steps: int) -> Sequence[int]:
    """The timesteps of a chain that stops early."""
    return range(NUM_STEPS - 1, NUM_STEPS - 1 - num_steps, -1)


def slow_obvious_future(
    folder: Path,
    observation: np.ndarray = WALK,
    *,
    seed: int,
    sample: int,
    chain: Sequence[int],
    leg: int = 0,
) -> np.ndarray:
    """One sample, one graph call after another, straight from the files."""
    manifest = read_manifest(folder)
    graph = {
        role: ort.InferenceSession(str(folder / spec.file), providers=["CPUExecutionProvider"])
        for role, spec in manifest.graphs().items()
    }
    assert manifest.schedule is not None
    alpha_bar = [*manifest.schedule.alpha_bar]
    variance = [np.array(v)[:, None] for v in manifest.schedule.variance]
    (context,) = graph["encoder"].run(None, {"observation": observation[None]})
    first = leg * (NUM_STEPS + 1)
    draws = [
        np.random.Generator(np.random.Philox(key=[seed, sample], counter=[0, 0, 0, first + k]))
        .standard_normal(X_T_SHAPE, dtype=np.float32)
        for k in range(len(chain) + 1)
    ]  # fmt: skip
    x_t = np.float32(np.sqrt(variance[-1]) * draws[0])
    for k, (t, after) in enumerate(zip_longest(chain, chain[1:])):
        feed = {"x_t": x_t[None], "timestep": np.array([t]), "context": context}
        x0 = graph["denoiser"].run(None, feed)[0][0]
        x_t = np.float32(
            ddim_step(
                x_t=x_t,
                x0=x0,
                alpha_bar=alpha_bar[t],
                variance=variance[t],
                alpha_bar_next=1.0 if after is None else alpha_bar[after],
                variance_next=0.0 if after is None else variance[after],
                eta=manifest.schedule.eta,
                noise=draws[k + 1],
            )
        )
    feed = {"x0": x0[None], "context": context, "observation": observation[None]}
    return graph["decoder"].run(None, feed)[0][0]


@pytest.mark.parametrize("num_steps", [1, 4, NUM_STEPS])
@pytest.mark.parametrize("bundle", ["diffusion", "stochastic"])
def test_engine_equals_a_loop_over_the_graphs(
    bundles: Path, stochastic_bundle: Path, bundle: str, num_steps: int
):
    folder = stochastic_bundle if bundle == "stochastic" else bundles / bundle
    answer = futures(engine_of(folder, rows_per_step=5), request(7, num_steps=num_steps))
    for sample in range(3):
        expected = slow_obvious_future(folder, seed=7, sample=sample, chain=early(num_steps))
        np.testing.assert_allclose(answer[sample], expected, atol=1e-6)


@pytest.mark.parametrize("bundle", ["diffusion", "stochastic"])
@pytest.mark.parametrize(
    ("num_steps", "chain"), [(None, (9, 7, 5, 3, 1)), (3, (9, 6, 3)), (1, (9,))]
)
def test_stride_walks_the_whole_chain_in_fewer_steps(
    bundles: Path,
    stochastic_bundle: Path,
    bundle: str,
    num_steps: int | None,
    chain: tuple[int, ...],
):
    folder = stochastic_bundle if bundle == "stochastic" else bundles / bundle
    manifest = read_manifest(folder)
    assert manifest.schedule is not None
    plan = manifest.schedule.model_copy(update={"plan": "stride", "default_steps": 5})
    runner = Runner(manifest.model_copy(update={"schedule": plan}), folder, threads=1)
    result = predict(Engine(runner), request(7, num_steps=num_steps))
    for sample in range(3):
        expected = slow_obvious_future(folder, seed=7, sample=sample, chain=chain)
        np.testing.assert_allclose(result.futures[sample], expected, atol=1e-6)
    assert (result.steps_run, result.steps_of, result.stopped_by) == (len(chain), len(chain), "end")


@pytest.mark.parametrize(
    ("num_steps", "run", "stopped_by"),
    [(None, 3, "end"), (2, 2, "num_steps"), (3, 3, "end"), (5, 5, "end")],
)
def test_only_who_asks_for_fewer_steps_than_the_default_is_told_so(
    bundles: Path, num_steps: int | None, run: int, stopped_by: str
):
    folder = bundles / "diffusion"
    manifest = read_manifest(folder)
    assert manifest.schedule is not None
    plan = manifest.schedule.model_copy(update={"default_steps": 3})
    runner = Runner(manifest.model_copy(update={"schedule": plan}), folder, threads=1)
    result = predict(Engine(runner), request(7, num_steps=num_steps))
    assert (result.steps_run, result.steps_of, result.stopped_by) == (run, 10, stopped_by)


def test_same_seed_gives_the_same_bytes_and_another_seed_another_future(bundles: Path):
    engine = engine_of(bundles / "diffusion")
    first, again, other = (futures(engine, request(seed)) for seed in (5, 5, 6))
    assert first.tobytes() == again.tobytes()
    assert np.abs(first - other).max() > 1e-3


def test_first_samples_do_not_depend_on_how_many_follow(bundles: Path):
    engine = engine_of(bundles / "diffusion")
    many = futures(engine, request(num_samples=40))
    assert futures(engine, request(num_samples=7)).tobytes() == many[:7].tobytes()


@pytest.mark.parametrize("rows_per_step", [1, 7, 64])
def test_result_does_not_depend_on_strangers(stochastic_bundle: Path, rows_per_step: int):
    alone = futures(engine_of(stochastic_bundle), request(3, num_samples=9, num_steps=6))
    engine = engine_of(stochastic_bundle, rows_per_step=rows_per_step)
    engine.add(request(1, num_samples=20))
    engine.step()
    mine = engine.add(request(3, num_samples=9, num_steps=6))
    for seed in range(4):
        engine.add(request(seed, num_samples=seed + 1, num_steps=seed + 1))
    ended: list[Result | Failure | Preview] = []
    while engine.num_requests:
        ended += engine.step()
    (result,) = [end for end in ended if end.request_id == mine]
    assert isinstance(result, Result)
    assert len(ended) == 6
    assert result.futures.tobytes() == alone.tobytes()


@pytest.mark.parametrize("rows_per_step", [3, 64])
@pytest.mark.parametrize("threads", [1, 2, 3])
def test_result_does_not_depend_on_how_many_threads_share_the_work(
    stochastic_bundle: Path, threads: int, rows_per_step: int
):
    requests = [
        request(seed, num_samples=1 + 4 * seed, num_steps=1 + 2 * seed, horizon=50 * seed + 1)
        for seed in range(5)
    ]
    alone = [futures(engine_of(stochastic_bundle), some) for some in requests]
    engine = engine_of(stochastic_bundle, rows_per_step=rows_per_step)
    for expected, events in zip(
        alone, run_by_threads(engine, requests, threads=threads), strict=True
    ):
        (result,) = events
        assert isinstance(result, Result)
        assert result.futures.tobytes() == expected.tobytes()


class CountingRunner(Runner):
    """Counts the rows that each graph has run, in whichever thread."""

    def __init__(self, folder: Path) -> None:
        super().__init__(read_manifest(folder), folder)
        self._ran: list[tuple[str, int]] = []

    @property
    def rows(self) -> Counter[str]:
        total: Counter[str] = Counter()
        for role, count in self._ran:
            total[role] += count
        return total

    def run(self, role: str, tensors: Tensors, parts: Sequence[Part]) -> Tensors:
        self._ran.append((role, sum(count for _, count in parts)))  # a sum would lose some
        return super().run(role, tensors, parts)


def test_observation_is_encoded_once_whoever_runs_its_rows(bundles: Path):
    runner = CountingRunner(bundles / "diffusion")
    requests = [request(seed, num_samples=20) for seed in range(10)]
    run_by_threads(Engine(runner, rows_per_step=8), requests, threads=4)
    assert runner.rows == {"encoder": 10, "denoiser": 10 * 20 * NUM_STEPS, "decoder": 10 * 20}


@pytest.mark.parametrize("bundle", ["diffusion", "stochastic"])
def test_longer_horizon_enters_the_last_frames_again(
    bundles: Path, stochastic_bundle: Path, bundle: str
):
    folder = stochastic_bundle if bundle == "stochastic" else bundles / bundle
    result = predict(engine_of(folder, rows_per_step=2), request(7, num_steps=3, horizon=130))
    assert result.futures.shape == (3, 130, 21, 3)
    assert (result.steps_run, result.steps_of, result.stopped_by) == (9, 30, "num_steps")
    for sample, future in enumerate(result.futures):
        frames = WALK
        for leg in range(3):
            seen = frames[-len(WALK) :]
            made = slow_obvious_future(folder, seen, seed=7, sample=sample, chain=early(3), leg=leg)
            frames = np.concatenate([frames, made])
        np.testing.assert_allclose(future, frames[len(WALK) :][:130], atol=2e-6)


def test_longer_horizon_continues_the_shorter_one(bundles: Path):
    engine = engine_of(bundles / "diffusion")
    short, plain, long = (futures(engine, request(horizon=h)) for h in (20, None, 100))
    assert short.tobytes() == plain[:, :20].tobytes()
    assert plain.tobytes() == long[:, :60].tobytes()


def test_single_future_of_all_samples_is_rolled_out(bundles: Path):
    result = predict(engine_of(bundles / "still"), request(num_samples=4, horizon=150))
    assert (result.steps_run, result.steps_of) == (3, 3)
    np.testing.assert_array_equal(result.futures, np.broadcast_to(WALK[-1], (4, 150, 21, 3)))


@pytest.mark.parametrize("threads", [1, 3])
def test_previews_are_what_fewer_steps_would_give_and_change_no_answer(
    stochastic_bundle: Path, threads: int
):
    some = request(5, num_samples=20, num_steps=6)
    engine = engine_of(stochastic_bundle, rows_per_step=7)
    strangers = [request(seed, num_samples=5) for seed in range(3)]
    asked = replace(some, previews=True)
    events, *_ = run_by_threads(engine, [asked, *strangers], threads=threads)
    *previews, result = sorted(events, key=lambda event: getattr(event, "steps_run", 0))
    assert isinstance(result, Result)
    assert result.futures.tobytes() == futures(engine, some).tobytes()
    assert len(previews) == 5
    for step, preview in enumerate(previews, 1):
        assert isinstance(preview, Preview)
        assert (preview.steps_run, preview.steps_of) == (step, NUM_STEPS)
        fewer = futures(engine, replace(some, num_steps=step))
        assert preview.futures.tobytes() == fewer.tobytes()


def test_previews_of_a_longer_horizon_show_what_there_is(bundles: Path):
    engine = engine_of(bundles / "diffusion")
    (events,) = run_by_threads(
        engine, [request(num_steps=2, horizon=100, previews=True)], threads=1
    )
    assert [event.futures.shape[1] for event in events] == [60, 60, 100, 100]  # type: ignore[union-attr]


def settled_at(steps: np.ndarray, tolerance_m: float) -> int:
    """The first step, from the second on, that moved one sample's future (K, H, J, 3) by less."""
    moved_m = np.linalg.norm(np.diff(steps, axis=0), axis=-1).max(axis=(1, 2))  # (K - 1,)
    near = np.flatnonzero(moved_m < tolerance_m)
    return 2 + int(near[0]) if len(near) else len(steps)


@pytest.mark.parametrize("tolerance_m", [1e-9, 0.2, 0.5, 99.0])
def test_sample_stops_once_a_step_moves_it_by_less_than_the_tolerance(
    bundles: Path, tolerance_m: float
):
    engine = engine_of(bundles / "diffusion", rows_per_step=9)
    by_step = [futures(engine, request(num_samples=30, num_steps=k + 1)) for k in range(NUM_STEPS)]
    samples = np.array(by_step).swapaxes(0, 1)  # (S, K, H, J, 3)
    stops = [settled_at(steps, tolerance_m) for steps in samples]
    result = predict(engine, request(num_samples=30, tolerance_m=tolerance_m))
    assert result.steps_run == max(stops)
    assert result.stopped_by == ("tolerance" if min(stops) < NUM_STEPS else "end")
    for future, steps, stop in zip(result.futures, samples, stops, strict=True):
        assert future.tobytes() == steps[stop - 1].tobytes()


def test_previews_count_samples_that_have_settled(bundles: Path):
    engine = engine_of(bundles / "diffusion")
    some = request(num_samples=30, tolerance_m=0.5, previews=True)
    (events,) = run_by_threads(engine, [some], threads=1)
    *previews, result = events
    assert isinstance(result, Result)
    assert [p.steps_run for p in previews] == list(range(1, result.steps_run))  # type: ignore[union-attr]
    assert result.stopped_by == "tolerance"
    assert result.futures.tobytes() == futures(engine, replace(some, previews=False)).tobytes()


def test_a_step_runs_no_more_rows_than_allowed_and_all_samples_advance_together(bundles: Path):
    engine = engine_of(bundles / "diffusion", rows_per_step=4)
    engine.add(request(num_samples=8, num_steps=3))
    steps = 0
    while engine.num_requests:
        engine.step()
        steps += 1
    assert steps == 8 * 3 / 4


def test_bundle_without_a_denoiser_repeats_its_one_future(bundles: Path):
    result = predict(engine_of(bundles / "still"), request(num_samples=4))
    assert (result.steps_run, result.steps_of) == (1, 1)
    np.testing.assert_array_equal(result.futures, np.broadcast_to(WALK[-1], (4, 60, 21, 3)))


def test_early_stop_says_how_many_steps_ran(bundles: Path):
    result = predict(engine_of(bundles / "diffusion"), request(num_steps=2))
    assert (result.steps_run, result.steps_of) == (2, NUM_STEPS)


def test_run_answers_in_order_and_reads_only_what_it_has_rows_for(bundles: Path):
    engine = engine_of(bundles / "diffusion", rows_per_step=4)
    read = 0

    def requests() -> Iterator[Request]:
        nonlocal read
        for seed in range(50):
            read += 1
            yield request(seed, num_steps=1 + seed % 3)

    answers = [result.futures for result in islice(engine.run(requests()), 5)]
    assert read < 15
    for seed, answer in enumerate(answers):
        alone = futures(engine_of(bundles / "diffusion"), request(seed, num_steps=1 + seed % 3))
        assert answer.tobytes() == alone.tobytes()


def test_nan_fails_its_own_request_and_no_other(bundles: Path):
    engine = engine_of(bundles / "diffusion")
    good = [engine.add(request(1)), engine.add(request(2))]
    bad = engine.add(Request(observation=TOO_FAST, num_samples=2))
    ended: list[Result | Failure | Preview] = []
    while engine.num_requests:
        ended += engine.step()
    assert sorted(end.request_id for end in ended if isinstance(end, Result)) == good
    (failure,) = [end for end in ended if isinstance(end, Failure)]
    assert failure.request_id == bad
    assert isinstance(failure.error, NonFiniteError)
    with pytest.raises(NonFiniteError, match="encoder gave NaN"):
        predict(engine, Request(observation=TOO_FAST))


def test_cancelled_request_frees_its_rows(bundles: Path):
    engine = engine_of(bundles / "diffusion", rows_per_step=2)
    engine.cancel(engine.add(request(num_samples=50)))
    assert engine.num_requests == 0
    assert engine.step() == []


class LeavingRunner(Runner):
    """A caller leaves while the first step runs."""

    leave: Callable[[], object] = staticmethod(lambda: None)

    def run(self, role: str, tensors: Tensors, parts: Sequence[Part]) -> Tensors:
        self.leave()
        return super().run(role, tensors, parts)


def test_rows_whose_caller_left_while_they_ran_are_counted(bundles: Path):
    folder = bundles / "diffusion"
    runner = LeavingRunner(read_manifest(folder), folder)
    engine = Engine(runner)
    leaver = engine.add(request(num_samples=3))
    engine.add(request(num_samples=2))
    runner.leave = lambda: engine.cancel(leaver)
    turns = [engine.turn(), engine.turn()]
    assert [(turn.num_rows, turn.num_unwanted) for turn in turns] == [(5, 3), (2, 0)]


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        (Request(observation=WALK[1:]), r"shape \(14, 21, 3\)"),
        (request(num_samples=0), "num_samples: found 0"),
        (request(num_steps=0), "num_steps: found 0"),
        (request(num_steps=11), "num_steps: found 11; diffusion runs 1 to 10"),
        (request(horizon=0), "horizon_s: found 0 s; diffusion makes a frame or more"),
        (request(tolerance_m=0.0), "tolerance_m: found 0 m; diffusion takes more than 0"),
    ],
)
def test_request_that_does_not_fit_is_refused(bundles: Path, bad: Request, message: str):
    with pytest.raises(FieldError, match=message):
        engine_of(bundles / "diffusion").add(bad)


def test_file_that_is_no_graph_is_refused(bundles: Path, tmp_path: Path):
    manifest = read_manifest(bundles / "still")
    (tmp_path / "decoder.onnx").write_bytes(b"not a graph")
    with pytest.raises(GraphError, match=r"decoder\.onnx: onnxruntime cannot load it"):
        Runner(manifest, tmp_path)


def test_graph_of_another_shape_fails_the_request(bundles: Path):
    manifest = read_manifest(bundles / "still").model_copy(update={"num_observed": 9})
    engine = Engine(Runner(manifest, bundles / "still"))
    with pytest.raises(GraphError, match="decoder could not run"):
        predict(engine, Request(observation=WALK[:9]))
