"""The engine on bundles that perform actions."""

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import onnxruntime as ort
import pytest
from threaded import run_by_threads
from tiny_bundles import (
    CHUNK_FRAMES,
    FPS,
    HORIZON,
    LABELS,
    MIN_FRAMES,
    NOISE_SHAPE,
    NUM_OBSERVED,
    walking,
    write_actions_bundle,
)

from models.bundle import read_manifest
from service.engine.context import Context, Part, Tensors
from service.engine.engine import Engine, predict
from service.engine.job import Job
from service.engine.performing import Performance
from service.engine.runner import Runner
from service.engine.stopping import rest_frames
from service.engine.trajectory import Failure, Preview, Request, Result, Samples, Segment
from service.errors import FieldError, NonFiniteError

WALK = walking().astype(np.float32)
TOO_FAST = walking(speed=99.0).astype(np.float32)
WINDOW, THRESHOLD_M = 5, 0.02


def engine_of(folder: Path, rows_per_step: int = 64) -> Engine:
    return Engine(Runner(read_manifest(folder), folder), rows_per_step=rows_per_step)


def request(*actions: int, seed: int = 0, num_samples: int = 3, **options: object) -> Request:
    return Request(
        observation=WALK,
        num_samples=num_samples,
        seed=seed,
        actions=actions,
        **options,  # type: ignore[arg-type]
    )


def run_all(engine: Engine) -> dict[int, Result | Failure]:
    ended: list[Result | Failure] = []
    while engine.num_requests:
        ended += engine.step()
    return {end.request_id: end for end in ended}


def slow_obvious_sample(
    folder: Path, actions: tuple[int, ...], *, seed: int, sample: int
) -> tuple[np.ndarray, list[Segment]]:
    """One sample straight from the files: every action to its longest, then cut where it rests."""
    encoder, decoder = (
        ort.InferenceSession(str(folder / name), providers=["CPUExecutionProvider"])
        for name in ("encoder.onnx", "decoder.onnx")
    )
    frames, segments = WALK, []
    for k, action in enumerate(actions):
        generator = np.random.Generator(np.random.Philox(key=[seed, sample], counter=[0, 0, 0, k]))
        noise = generator.standard_normal(NOISE_SHAPE, dtype=np.float32)
        seen = frames[-NUM_OBSERVED:]
        goal, pose = encoder.run(None, {"observation": seen[None], "action": np.array([action])})
        chunks = []
        for _ in range(-(-HORIZON // CHUNK_FRAMES)):
            chunk, pose = decoder.run(None, {"noise": noise[None], "goal": goal, "pose": pose})
            chunks.append(chunk[0])
        made = np.concatenate(chunks)[:HORIZON]
        (rest,) = rest_frames(
            made[None],
            start=np.array([MIN_FRAMES - 1]),
            window=WINDOW,
            threshold_m=THRESHOLD_M,
        )
        made = made if rest < 0 else made[: rest + 1]
        start = len(frames) - NUM_OBSERVED
        end = start + len(made)
        segments.append(Segment(action=action, start=start, end=end, stopped=bool(rest >= 0)))
        frames = np.concatenate([frames, made])
    return frames[NUM_OBSERVED:], segments


@pytest.mark.parametrize("actions", [(0,), (2, 1, 2)])
def test_engine_equals_a_loop_over_the_graphs(actions_bundle: Path, actions: tuple[int, ...]):
    result = predict(
        engine_of(actions_bundle, rows_per_step=7), request(*actions, seed=7, num_samples=12)
    )
    for sample, (future, segments) in enumerate(zip(result.futures, result.segments, strict=True)):
        expected, parts = slow_obvious_sample(actions_bundle, actions, seed=7, sample=sample)
        assert list(segments) == parts
        np.testing.assert_allclose(future[: len(expected)], expected, atol=1e-6)


def test_futures_have_lengths_of_their_own_and_repeat_their_last_frame(actions_bundle: Path):
    result = predict(engine_of(actions_bundle), request(0, 1, num_samples=20))
    lengths = [segments[-1].end for segments in result.segments]
    assert len(set(lengths)) > 3
    assert result.futures.shape[1] == max(lengths)
    assert result.futures.flags.c_contiguous
    for future, length in zip(result.futures, lengths, strict=True):
        assert np.all(future[length:] == future[length - 1])


def test_windows_of_rest_cross_the_borders_of_chunks(actions_bundle: Path):
    result = predict(engine_of(actions_bundle), request(0, num_samples=40))
    last = [segments[0].end - 1 for segments in result.segments if segments[0].stopped]
    assert any(frame % CHUNK_FRAMES > CHUNK_FRAMES - WINDOW for frame in last)


def test_segments_follow_each_other_without_a_gap(actions_bundle: Path):
    result = predict(engine_of(actions_bundle), request(2, 0, 1, num_samples=8))
    for segments in result.segments:
        assert [segment.action for segment in segments] == [2, 0, 1]
        assert [segment.start for segment in segments] == [0, *(s.end for s in segments[:-1])]


def test_action_does_not_depend_on_those_that_follow(actions_bundle: Path):
    engine = engine_of(actions_bundle)
    one, many = (predict(engine, request(*actions)) for actions in ((1,), (1, 0, 2)))
    for short, long, (segment,) in zip(one.futures, many.futures, one.segments, strict=True):
        assert short[: segment.end].tobytes() == long[: segment.end].tobytes()


def test_next_action_sets_out_from_where_the_body_rests(actions_bundle: Path):
    result = predict(engine_of(actions_bundle), request(0, 1, num_samples=10))
    for future, (first, _) in zip(result.futures, result.segments, strict=True):
        # This bundle's bodies go straight from the pose they are in to their goal.
        rest, near, far = future[first.end - 1 : first.end + 2].reshape(3, -1).astype(np.float64)
        ways = np.array([near - rest, far - rest])
        near_way, far_way = ways / np.linalg.norm(ways, axis=-1, keepdims=True)
        np.testing.assert_allclose(near_way, far_way, atol=1e-5)


def test_longest_action_is_cut_off_and_says_so(actions_bundle: Path):
    result = predict(engine_of(actions_bundle), request(0, 1, max_frames=11, stop_threshold_m=1e-9))
    assert result.futures.shape[1] == 22
    for segments in result.segments:
        assert [segment.end for segment in segments] == [11, 22]
        assert not any(segment.stopped for segment in segments)


def test_action_lasts_to_the_horizon_where_the_body_never_rests(actions_bundle: Path):
    result = predict(engine_of(actions_bundle), request(0, stop_threshold_m=1e-9))
    assert {segments[0].end for segments in result.segments} == {HORIZON}


def test_decoder_may_say_before_when_rest_is_no_end(tmp_path: Path):
    engine = engine_of(write_actions_bundle(tmp_path / "later", earliest_end=21.7))
    result = predict(engine, request(0, 1, stop_threshold_m=99.0))
    assert [segment.end for segment in result.segments[0]] == [21, 42]
    result = predict(engine, request(0, stop_threshold_m=99.0, max_frames=15))
    assert result.futures.shape[1] == 15


def test_lenient_threshold_ends_an_action_at_its_shortest(actions_bundle: Path):
    result = predict(engine_of(actions_bundle), request(0, stop_threshold_m=99.0))
    assert {segments[0].end for segments in result.segments} == {MIN_FRAMES}
    assert all(segments[0].stopped for segments in result.segments)


@pytest.mark.parametrize("draws", ["decoder", "encoder"])
@pytest.mark.parametrize("rows_per_step", [1, 7, 64])
def test_result_does_not_depend_on_strangers(tmp_path: Path, draws: str, rows_per_step: int):
    folder = write_actions_bundle(tmp_path / "actions", draws=draws)
    mine = request(2, 0, seed=3, num_samples=6)
    alone = predict(engine_of(folder), mine)
    engine = engine_of(folder, rows_per_step=rows_per_step)
    engine.add(request(1, seed=1, num_samples=9))
    engine.step()
    request_id = engine.add(mine)
    for seed in range(4):
        engine.add(request(*[seed % 3] * (1 + seed), seed=seed, num_samples=seed + 1))
    ended = run_all(engine)
    result = ended[request_id]
    assert isinstance(result, Result)
    assert len(ended) == 6
    assert result.segments == alone.segments
    assert result.futures.tobytes() == alone.futures.tobytes()


def test_first_samples_do_not_depend_on_how_many_follow(actions_bundle: Path):
    engine = engine_of(actions_bundle)
    many, few = (predict(engine, request(0, 2, num_samples=n)) for n in (20, 4))
    assert few.segments == many.segments[:4]
    length = few.futures.shape[1]
    assert few.futures.tobytes() == many.futures[:4, :length].tobytes()


def test_every_action_has_noise_of_its_own(tmp_path: Path):
    folder = write_actions_bundle(tmp_path / "actions", draws="encoder")
    result = predict(engine_of(folder), request(0, 0, num_samples=1, stop_threshold_m=1e-9))
    paces = []
    for segment in result.segments[0]:
        made = result.futures[0, segment.start : segment.end].astype(np.float64)
        paces.append(np.linalg.norm(made[3] - made[2]) / np.linalg.norm(made[2] - made[1]))
    assert abs(paces[0] - paces[1]) > 1e-3


def test_bundle_without_noise_repeats_its_one_future(tmp_path: Path):
    folder = write_actions_bundle(tmp_path / "actions", draws=None)
    result = predict(engine_of(folder), request(0, 1, num_samples=4))
    assert result.futures.shape[0] == len(result.segments) == 4
    assert len(set(result.segments)) == 1
    assert np.all(result.futures == result.futures[0])


class RecordingRunner(Runner):
    calls: list[tuple[str, int]]

    def run(self, role: str, tensors: Tensors, parts: Sequence[Part]) -> Tensors:
        self.calls.append((role, sum(count for _, count in parts)))
        return super().run(role, tensors, parts)


def test_observation_is_encoded_once_and_rows_that_turn_together_in_one_batch(
    actions_bundle: Path,
):
    runner = RecordingRunner(read_manifest(actions_bundle), actions_bundle)
    runner.calls = []
    # Every row ends its first action, of one chunk, in the same turn.
    predict(Engine(runner), request(0, 1, num_samples=5, max_frames=CHUNK_FRAMES))
    assert runner.calls == [("encoder", 1), ("decoder", 5), ("encoder", 5), ("decoder", 5)]


@pytest.mark.parametrize("threads", [1, 3])
@pytest.mark.parametrize("actions", [(1,), (2, 0, 1)])
def test_previews_are_the_frames_so_far_and_change_no_answer(
    actions_bundle: Path, actions: tuple[int, ...], threads: int
):
    some = request(*actions, seed=3, num_samples=20)
    engine = engine_of(actions_bundle, rows_per_step=7)
    strangers = [request(1, 2, seed=seed, num_samples=5) for seed in range(3)]
    asked = replace(some, previews=True)
    events, *_ = run_by_threads(engine, [asked, *strangers], threads=threads)
    (result,) = [event for event in events if isinstance(event, Result)]
    previews = sorted((e for e in events if isinstance(e, Preview)), key=lambda e: e.steps_run)
    alone = predict(engine, some)
    assert (result.segments, result.steps_run) == (alone.segments, alone.steps_run)
    assert result.futures.tobytes() == alone.futures.tobytes()
    assert [preview.steps_run for preview in previews] == list(range(1, result.steps_run))
    assert {event.steps_of for event in (*previews, result)} == {len(actions) * 8}
    for preview in previews:
        for row in range(20):
            *ended, last = preview.segments[row]
            whole = result.segments[row]
            future, shown = result.futures[row], preview.futures[row]
            assert tuple(ended) == whole[: len(ended)]
            if last.stopped:
                assert last == whole[len(ended)]
            else:
                made = last.end - last.start
                assert made == HORIZON or made % CHUNK_FRAMES == 0
            same = min(last.end, whole[len(ended)].end)
            assert shown[:same].tobytes() == future[:same].tobytes()
            assert np.all(shown[last.end :] == shown[last.end - 1])
    # Nobody is shown to be farther than their chunks go, nor less far.
    first = previews[0].segments
    assert all(0 < segments[-1].end <= CHUNK_FRAMES for segments in first)


def test_previews_of_samples_that_are_alike_are_those_of_all(tmp_path: Path):
    folder = write_actions_bundle(tmp_path / "actions", draws=None)
    (events,) = run_by_threads(
        engine_of(folder), [request(0, 1, num_samples=4, previews=True)], threads=1
    )
    assert len(events) > 2
    for event in events:
        assert isinstance(event, Preview | Result)
        assert len(event.futures) == len(event.segments) == 4


def test_samples_that_were_cut_do_not_stand_for_those_of_another_thread():
    """Cut rows are whole at the step that they were shown at, and still count once."""
    some = request(0, num_samples=4, previews=True)
    job = Job(request_id=1, request=some, steps_of=8, num_rows=4, deadline_s=math.inf, added_s=0.0)
    frames = np.zeros((2, CHUNK_FRAMES, 21, 3), np.float32)
    shown = Performance(
        request_id=1,
        request=some,
        sample_indices=np.arange(2),
        turns_left=7,
        context=Context(tensors={"observation": WALK[None]}),
        past=(WALK, WALK),
        segments=((), ()),
        steps_run=np.array([1, 1]),
        chunks=(frames,),
    )
    job.show(shown)
    segment = Segment(action=0, start=0, end=CHUNK_FRAMES, stopped=False)
    job.put(
        Samples(
            request_id=1,
            sample_indices=np.arange(2),
            futures=frames,
            steps_run=1,
            stopped_by="deadline",
            segments=((segment,), (segment,)),
        )
    )
    assert job.ready() == []
    job.show(replace(shown, sample_indices=np.array([2, 3])))
    (shown_by_all,) = job.ready()
    preview = job.preview(*shown_by_all)
    assert (preview.steps_run, preview.segments) == (1, ((segment,),) * 4)


def test_nan_fails_its_own_request_and_no_other(actions_bundle: Path):
    engine = engine_of(actions_bundle)
    good = [engine.add(request(0, seed=1)), engine.add(request(1, 2, seed=2))]
    bad = engine.add(Request(observation=TOO_FAST, num_samples=2, actions=(0, 1)))
    ended = run_all(engine)
    failure = ended.pop(bad)
    assert isinstance(failure, Failure)
    assert isinstance(failure.error, NonFiniteError)
    assert sorted(ended) == good
    alone = predict(engine_of(actions_bundle), request(1, 2, seed=2))
    result = ended[good[1]]
    assert isinstance(result, Result)
    assert result.futures.tobytes() == alone.futures.tobytes()


def test_cancelled_request_frees_its_rows(actions_bundle: Path):
    engine = engine_of(actions_bundle, rows_per_step=4)
    request_id = engine.add(request(0, 1, num_samples=50))
    engine.step()
    engine.cancel(request_id)
    assert engine.num_requests == 0
    assert engine.step() == []


@pytest.mark.parametrize(
    ("bad", "pointer", "message"),
    [
        (request(), "/actions", "found none; actions performs one action or more of reach, "),
        (request(0, 3), "/actions", "found action 3; actions performs one action or more"),
        (request(-1), "/actions", "found action -1"),
        (request(0, max_frames=0), "/max_seconds_per_action", "found 0 s"),
        (
            request(0, max_frames=HORIZON + 15),
            "/max_seconds_per_action",
            f"found 2.5 s; actions performs an action for at most {HORIZON / FPS:g} s",
        ),
        (
            request(0, stop_threshold_m=0.0),
            "/stop_threshold",
            "found 0 m; actions takes a threshold above 0",
        ),
        (request(0, stop_threshold_m=float("nan")), "/stop_threshold", "found nan m"),
        (request(0, num_steps=2), "/num_steps", "actions runs 1 to 1 steps"),
    ],
)
def test_request_that_does_not_fit_is_refused(
    actions_bundle: Path, bad: Request, pointer: str, message: str
):
    with pytest.raises(FieldError, match=message) as refusal:
        engine_of(actions_bundle).add(bad)
    assert refusal.value.pointer == pointer


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        (request(0), "actions: found action 0; diffusion performs no actions"),
        (request(max_frames=9), "max_seconds_per_action: found 0.3 s"),
        (request(stop_threshold_m=0.1), "stop_threshold: found 0.1 m; diffusion performs no"),
    ],
)
def test_bundle_that_performs_no_actions_refuses_them(bundles: Path, bad: Request, message: str):
    with pytest.raises(FieldError, match=message):
        engine_of(bundles / "diffusion").add(bad)


def test_labels_and_examples_are_read_back(actions_bundle: Path):
    spec = read_manifest(actions_bundle).actions
    assert spec is not None
    assert spec.labels == LABELS
    assert spec.examples == {"wave": "raises a hand"}
