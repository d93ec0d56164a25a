import shutil
from pathlib import Path
from typing import Any

import numpy as np
import orjson
import pytest
from in_memory import Service, dumped
from tiny_bundles import FPS, HORIZON, LABELS, MIN_FRAMES, walking

from models.bundle import Manifest, read_manifest
from models.motion.kinematics import bone_lengths
from models.motion.skeleton import BODY21, H36M17, joint_map
from service.catalog import Catalog
from service.engine.engine import Engine, predict
from service.engine.runner import Runner
from service.engine.trajectory import Request, Segment
from service.errors import FieldError, UnknownActionError
from service.futures import caller_segments
from service.poses.actions import action_indices, max_frames

WALK = walking()
PATH = "/predict_actions"
ACTIONS = ["reach", "wave", "reach"]


def fields(**options: Any) -> dict[str, Any]:
    return {"poses": WALK, "actions": ACTIONS, "num_samples": 3, "seed": 5, **options}


def answered(service: Service, **options: Any) -> dict[str, Any]:
    response = service.post(fields(**options), PATH)
    assert response.status_code == 200, response.text
    answer: dict[str, Any] = orjson.loads(response.content)
    return answer


def performed(service: Service, **options: Any) -> list[np.ndarray]:
    """The poses of each future of an answer that must be a good one."""
    return [np.array(future["poses"]) for future in answered(service, **options)["futures"]]


@pytest.fixture(scope="module")
def manifest(actions_bundle: Path) -> Manifest:
    return read_manifest(actions_bundle)


def test_answer_says_all_there_is_to_know(performing_service: Service):
    answer = answered(performing_service, num_samples=6, skeleton="body21", fps=30)
    assert set(answer) == {
        "id", "model", "seed", "fps", "skeleton", "joints", "joint_sources", "futures", "warnings",
        "timing_ms",
    }  # fmt: skip
    assert answer["model"]["name"] == "actions"
    assert (answer["seed"], answer["fps"], answer["skeleton"]) == (5, 30, "body21")
    assert answer["joints"] == list(BODY21.joints)
    for future in answer["futures"]:
        assert np.shape(future["poses"]) == (future["num_frames"], 21, 3)
        segments = future["segments"]
        assert [segment["action"] for segment in segments] == ACTIONS
        assert [0, *(segment["end"] for segment in segments)] == [
            *(segment["start"] for segment in segments), future["num_frames"],
        ]  # fmt: skip
    assert len({future["num_frames"] for future in answer["futures"]}) > 1


@pytest.mark.parametrize("actions", [["wave"], ACTIONS, ["crouch"] * 16])
def test_answer_is_what_the_engine_performed(
    performing_service: Service, actions_bundle: Path, manifest: Manifest, actions: list[str]
):
    request = Request(
        observation=WALK.astype(np.float32),
        num_samples=3,
        seed=5,
        actions=tuple(LABELS.index(label) for label in actions),
    )
    result = predict(Engine(Runner(manifest, actions_bundle)), request)
    answer = answered(performing_service, actions=actions, bone_lengths="free")
    for future, expected, segments in zip(
        answer["futures"], result.futures, result.segments, strict=True
    ):
        np.testing.assert_allclose(future["poses"], expected[: segments[-1].end], atol=1.5e-4)
        found = [(part["start"], part["end"], part["stopped"]) for part in future["segments"]]
        assert found == [(part.start, part.end, part.stopped) for part in segments]


def test_both_paths_answer_alike(performing_service: Service):
    first, second = (
        orjson.loads(performing_service.post(fields(), path).content)["futures"]
        for path in (PATH, f"/v1{PATH}")
    )
    assert first == second


def test_seed_is_returned_and_repeats_the_futures(performing_service: Service):
    drawn = answered(performing_service, seed=None)
    assert answered(performing_service, seed=drawn["seed"])["futures"] == drawn["futures"]
    assert answered(performing_service, seed=None)["futures"] != drawn["futures"]


@pytest.mark.parametrize("fps", [20.0, 30.0, 50.0])
def test_future_does_not_depend_on_how_long_the_others_are(performing_service: Service, fps: float):
    poses = walking(round(fps * 0.6), fps=fps)
    many = answered(performing_service, poses=poses, fps=fps, num_samples=8)["futures"]
    few = [
        answered(performing_service, poses=poses, fps=fps, num_samples=count)["futures"]
        for count in (1, 3)
    ]
    assert [many[:1], many[:3]] == few


@pytest.mark.parametrize("fps", [5.0, 20.0, 24.0, 29.97, 60.0, 120.0])
def test_segments_count_frames_of_the_callers_rate(performing_service: Service, fps: float):
    poses = walking(round(fps * 0.8), fps=fps)
    ours = answered(performing_service)["futures"]
    theirs = answered(performing_service, poses=poses, fps=fps)["futures"]
    for our, their in zip(ours, theirs, strict=True):
        assert len(their["poses"]) == their["num_frames"] == their["segments"][-1]["end"]
        assert [part["start"] for part in their["segments"]][1:] == [
            part["end"] for part in their["segments"]
        ][:-1]
        for one, other in zip(our["segments"], their["segments"], strict=True):
            assert abs(one["end"] / FPS - other["end"] / fps) <= 0.5 / fps + 1e-9
            assert one["stopped"] == other["stopped"]


def test_rates_agree_where_their_frames_coincide(performing_service: Service):
    at_30 = performed(performing_service, bone_lengths="free")
    twice = walking(31, fps=60.0)
    at_60 = performed(performing_service, poses=twice, fps=60, bone_lengths="free")
    for slow, fast in zip(at_30, at_60, strict=True):
        np.testing.assert_allclose(fast[1::2], slow, atol=2e-4)


@pytest.mark.parametrize("length", range(1, 9))
def test_future_shorter_than_a_frame_of_the_caller_has_one(manifest: Manifest, length: int):
    parts = [Segment(action=0, start=0, end=length, stopped=True)]
    ((part,),) = caller_segments([parts], manifest=manifest, fps=5.0)
    assert (part.start, part.end) == (0, max(1, round(length / 6)))


def test_any_world_axes_units_and_skeleton(performing_service: Service):
    here = performed(performing_service)
    moved = performed(performing_service, poses=WALK + np.array([30.0, -2.0, 0.0]))
    y_up_mm = np.ascontiguousarray(WALK[..., [1, 2, 0]]) * 1000.0
    turned = performed(performing_service, poses=y_up_mm, axes={"up": "y", "units": "mm"})
    for expected, far, millimetres in zip(here, moved, turned, strict=True):
        np.testing.assert_allclose(far - [30.0, -2.0, 0.0], expected, atol=2e-4)
        np.testing.assert_allclose(millimetres[..., [2, 0, 1]] / 1000.0, expected, atol=2e-4)
    weights, _ = joint_map(BODY21, H36M17)
    poses = np.einsum("ij,tjk->tik", weights, WALK)
    lengths = bone_lengths(poses[-1], H36M17.parents)
    for future in performed(performing_service, poses=poses, skeleton="h36m17"):
        found = bone_lengths(future, H36M17.parents)
        np.testing.assert_allclose(found, np.broadcast_to(lengths, found.shape), atol=2e-3)


def test_coarser_threshold_ends_an_action_sooner(performing_service: Service):
    def ends(**options: Any) -> list[int]:
        futures = answered(performing_service, actions=["reach"], **options)["futures"]
        return [future["num_frames"] for future in futures]

    default = ends()
    assert ends(stop_threshold=0.02) == default
    assert all(coarse < end for coarse, end in zip(ends(stop_threshold=0.2), default, strict=True))
    assert ends(stop_threshold=1.0) == [MIN_FRAMES] * 3
    assert ends(stop_threshold=1e-9) == [HORIZON] * 3


def test_action_is_cut_off_at_its_longest_and_it_is_said(performing_service: Service):
    for future in answered(performing_service, max_seconds_per_action=0.2)["futures"]:
        assert [part["end"] for part in future["segments"]] == [6, 12, 18]
        assert not any(part["stopped"] for part in future["segments"])
    longest = answered(performing_service, max_seconds_per_action=HORIZON / FPS)
    assert longest["futures"] == answered(performing_service)["futures"]


@pytest.mark.parametrize(
    ("seconds", "frames"),
    [(None, None), (1 / 30, 1), (0.033, 1), (1.0, 30), (2.0, 60), (2.0004, 60)],
)
def test_seconds_are_whole_frames_of_the_bundle(
    manifest: Manifest, seconds: float | None, frames: int | None
):
    assert max_frames(seconds, manifest) == frames


@pytest.mark.parametrize("seconds", [0.001, 2.01, 1e9, float("nan"), float("inf")])
def test_seconds_out_of_range_are_refused(manifest: Manifest, seconds: float):
    with pytest.raises(FieldError, match=r"performs an action for 0.033 s to 2.000 s"):
        max_frames(seconds, manifest)


@pytest.mark.parametrize(
    ("label", "nearest"),
    [
        ("Wave", "; the nearest is wave"),
        ("raech", "; the nearest is reach"),
        ("zzz", ""),
        ("", ""),
        ("ouch", "; the nearest is crouch"),
    ],
)
def test_unknown_action_tells_the_known_ones_and_the_nearest(
    manifest: Manifest, label: str, nearest: str
):
    with pytest.raises(UnknownActionError) as caught:
        action_indices(["wave", label], manifest)
    assert caught.value.pointer == "/actions/1"
    assert caught.value.expected == f"must be one of reach, crouch, wave{nearest}"


# fmt: off
CASES = [
    ("invalid-field", "/actions", {"poses": WALK}, "nothing"),
    ("invalid-field", "/actions", fields(actions=[]), "a list of 0"),
    ("invalid-field", "/actions", fields(actions=["wave"] * 17), "a list of 17"),
    ("invalid-field", "/actions", fields(actions="wave"), '"wave"'),
    ("invalid-field", "/actions/1", fields(actions=["wave", 3]), "3"),
    ("unknown-action", "/actions/2", fields(actions=["wave", "reach", "fly"]), "'fly'"),
    ("unsuitable-model", "/model", fields(model="diffusion"), "'diffusion'"),
    ("unknown-model", "/model", fields(model="oracle"), "'oracle'"),
    ("invalid-field", "/stop_threshold", fields(stop_threshold=0), "0"),
    ("invalid-field", "/stop_threshold", fields(stop_threshold=-0.1), "-0.1"),
    ("invalid-field", "/stop_threshold", fields(stop_threshold=15.0), "15.0"),
    ("invalid-field", "/stop_threshold", fields(stop_threshold="wide"), '"wide"'),
    ("invalid-field", "/max_seconds_per_action", fields(max_seconds_per_action=0), "0"),
    ("invalid-field", "/max_seconds_per_action", fields(max_seconds_per_action=2.1), "2.1 s"),
    ("invalid-field", "/max_seconds_per_action", fields(max_seconds_per_action=0.01), "0.01 s"),
    ("invalid-field", "/num_steps", fields(num_steps=1), "a field that is not known"),
    ("invalid-field", "/num_samples", fields(num_samples=201), "201"),
    ("invalid-field", "/num_samples", fields(num_samples=200, actions=["wave"] * 16, fps=60,
                                                poses=walking(30, fps=60.0)),
     "200 futures of up to 1920 frames"),
    ("too-few-frames", "/poses", fields(poses=WALK[:14]), "14 frames at 30 fps"),
    ("unknown-skeleton", "/skeleton", fields(skeleton="octopus"), "'octopus'"),
]
# fmt: on


@pytest.mark.parametrize(("slug", "pointer", "body", "found"), CASES)
def test_field_at_fault_is_named_with_what_was_found(
    performing_service: Service, slug: str, pointer: str, body: dict[str, Any], found: str
):
    response = performing_service.post(body, PATH)
    problem = response.json()
    assert response.headers["content-type"] == "application/problem+json"
    assert response.status_code == problem["status"] == 422
    assert (problem["type"], problem["pointer"]) == (f"/problems/{slug}", pointer)
    assert problem["found"].startswith(found)
    assert f"found {problem['found']}; {problem['expected']}." in problem["detail"]


@pytest.mark.parametrize("literal", [b"NaN", b"Infinity", b"1e999"])
@pytest.mark.parametrize("name", ["stop_threshold", "max_seconds_per_action"])
def test_number_that_json_lacks_is_refused(performing_service: Service, name: str, literal: bytes):
    body = dumped(fields(**{name: 0.5})).replace(b":0.5", b":" + literal)
    problem = performing_service.post(body, PATH).json()
    assert (problem["status"], problem["pointer"]) == (422, f"/{name}")


def test_models_of_the_right_kind_are_told(performing_service: Service):
    problem = performing_service.post(fields(model="still"), PATH).json()
    assert problem["expected"] == "must be one that performs actions: actions"
    problem = performing_service.post({"poses": WALK, "model": "actions"}).json()
    assert (problem["status"], problem["type"]) == (422, "/problems/unsuitable-model")
    assert problem["expected"] == "must be one that predicts without actions: diffusion, still"
    problem = performing_service.post({"poses": WALK, "actions": ["wave"]}).json()
    assert (problem["pointer"], problem["found"]) == ("/actions", "a field that is not known")


def test_nan_of_a_graph_never_leaves_and_the_server_goes_on(performing_service: Service):
    alone = answered(performing_service)["futures"]
    response = performing_service.post(fields(poses=walking(speed=99.0)), PATH)
    assert (response.status_code, response.json()["type"]) == (500, "/problems/prediction-failed")
    assert answered(performing_service)["futures"] == alone


def test_server_without_actions_says_so(service: Service):
    response = service.post(fields(), PATH)
    assert (response.status_code, response.json()["type"]) == (503, "/problems/unavailable")
    assert "found no bundle that performs actions" in response.json()["detail"]
    assert service.get("/actions").json() == {"default_model": None, "actions": []}
    problem = service.post(fields(model="still"), PATH).json()
    assert problem["expected"] == "must be one that performs actions: none is here"


def test_actions_are_listed_with_examples_and_models(performing_service: Service):
    assert performing_service.get("/actions").json() == {
        "default_model": "actions",
        "actions": [
            {"label": "reach", "example": None, "models": ["actions"]},
            {"label": "crouch", "example": None, "models": ["actions"]},
            {"label": "wave", "example": "raises a hand", "models": ["actions"]},
        ],
    }
    assert performing_service.get("/models/actions").json()["actions"] == list(LABELS)
    assert performing_service.get("/models/still").json()["actions"] == []


def test_documents_declare_every_error_and_an_example(performing_service: Service):
    document = performing_service.get("/openapi.json").json()
    responses = document["paths"][PATH]["post"]["responses"]
    assert set(responses) == {
        "200", "400", "401", "406", "409", "413", "415", "422", "429", "500", "503", "504",
    }  # fmt: skip
    schemas = document["components"]["schemas"]
    (example,) = schemas["PredictActionsRequest"]["examples"]
    assert performing_service.post(example | {"actions": ["wave"]}, PATH).status_code == 200
    answer = answered(performing_service)
    assert set(schemas["PredictActionsResponse"]["properties"]) == set(answer) | {"occupancy"}
    assert set(schemas["PerformedFuture"]["properties"]) == set(answer["futures"][0])


@pytest.fixture
def copies(bundles_with_actions: Path, tmp_path: Path) -> Path:
    return shutil.copytree(bundles_with_actions, tmp_path / "copies")


def defaults(folder: Path, default_model: str | None = None) -> list[str | None]:
    """Which bundles answer requests without actions and with, by name."""
    catalog = Catalog(folder, default_model=default_model, threads=1)
    catalog.load()
    catalog.stop()
    chosen = [catalog.default(with_actions=kind) for kind in (False, True)]
    return [entry.name if entry else None for entry in chosen]


# fmt: off
PREFERENCES = [
    ("actions\ndiffusion\n", ["diffusion", "actions"]),
    ("still\nactions\ndiffusion", ["still", "actions"]),
    ("still\n", ["still", "actions"]),
    ("actions\n", ["diffusion", "actions"]),
    (None, ["diffusion", "actions"]),
]
# fmt: on


@pytest.mark.parametrize(("lines", "expected"), PREFERENCES)
def test_defaults_are_the_first_of_their_kind(copies: Path, lines: str | None, expected: list[str]):
    (copies / "DEFAULT").unlink()
    if lines is not None:
        (copies / "DEFAULT").write_text(lines)
    assert defaults(copies) == expected
    assert defaults(copies, "still") == ["still", "actions"]
    assert defaults(copies, "actions") == ["diffusion", "actions"]


def test_refused_bundle_gives_way_to_the_next_in_order(copies: Path):
    (copies / "DEFAULT").write_text("diffusion\nstill\nactions\n")
    assert defaults(copies) == ["diffusion", "actions"]
    (copies / "diffusion" / "decoder.onnx").unlink()
    assert defaults(copies) == ["still", "actions"]
    (copies / "DEFAULT").write_text("diffusion\n")  # the only one that was asked for
    assert defaults(copies) == ["diffusion", "actions"]
    (copies / "actions" / "decoder.onnx").unlink()
    assert defaults(copies) == ["diffusion", None]


def test_server_with_actions_alone_predicts_nothing_without_them(
    actions_bundle: Path, tmp_path: Path
):
    shutil.copytree(actions_bundle, tmp_path / "actions")
    with Service.of(tmp_path) as service:
        service.wait_until_loaded()
        assert service.get("/readyz").json()["models"] == {"actions": "ready"}
        response = service.post({"poses": WALK})
        assert response.status_code == 503
        assert "found no bundle that predicts without actions" in response.json()["detail"]
        assert service.post(fields(), PATH).status_code == 200
