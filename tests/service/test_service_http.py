import re
from itertools import chain

import numpy as np
import orjson
import pytest
from in_memory import JSON, Service, dumped, untimed
from tiny_bundles import walking

from models.motion.axes import Axes
from models.motion.kinematics import bone_lengths, rotate_yaw
from models.motion.skeleton import BODY21, SENT_ORDERS, SKELETONS, joint_map

WALK = walking()


METRES = {"up": "z", "units": "m"}


def in_skeleton(name: str, poses: np.ndarray = WALK) -> np.ndarray:
    """Poses in a standard skeleton, metres, +Z up, its joints as they are sent."""
    weights, _ = joint_map(BODY21, SKELETONS[name])
    sent = np.empty((len(poses), len(weights), 3))
    sent[:, list(SENT_ORDERS[name])] = np.einsum("ij,tjk->tik", weights, poses)
    return sent


def test_answer_says_all_there_is_to_know(service: Service):
    response = service.post({"poses": WALK, "skeleton": "body21", "fps": 30, "num_samples": 3})
    assert response.headers["content-type"] == "application/json"
    answer = orjson.loads(response.content)
    assert set(answer) == {
        "id", "model", "seed", "fps", "skeleton", "joints", "joint_sources", "num_frames",
        "futures", "steps", "warnings", "timing_ms",
    }  # fmt: skip
    assert answer["model"]["name"] == "diffusion"
    assert len(answer["model"]["digest"]) == 16
    assert 0 <= answer["seed"] < 2**53
    assert (answer["fps"], answer["skeleton"], answer["num_frames"]) == (30, "body21", 60)
    assert answer["joints"] == list(BODY21.joints)
    assert np.shape(answer["futures"]) == (3, 60, 21, 3)
    assert answer["steps"] == {"run": 10, "of": 10, "stopped_by": "end"}
    assert answer["warnings"] == []
    assert answer["id"] == response.headers["x-request-id"]
    stages = re.findall(r"(\w+);dur=([\d.]+)(?:, |$)", response.headers["server-timing"])
    assert (
        [name for name, _ in stages] == list(answer["timing_ms"]) == ["queue", "engine", "answer"]
    )


def test_only_poses_are_required(service: Service):
    answer = orjson.loads(service.post({"poses": WALK}).content)
    assert np.shape(answer["futures"]) == (10, 60, 21, 3)


def test_coordinates_have_a_tenth_of_a_millimetre(service: Service):
    text = service.post({"poses": WALK, "num_samples": 1}).text
    futures = text.split('"futures":', 1)[1].split("]]]]", 1)[0]
    assert max(len(number.split(".")[1]) for number in futures.strip("[]").split(",")
               if "." in number and "[" not in number and "]" not in number) <= 4  # fmt: skip


def test_returned_seed_gives_the_same_futures_again(service: Service):
    first = orjson.loads(service.post({"poses": WALK, "num_samples": 2}).content)
    again = orjson.loads(
        service.post({"poses": WALK, "num_samples": 2, "seed": first["seed"]}).content
    )
    assert first["futures"] == again["futures"]
    other = orjson.loads(service.post({"poses": WALK, "num_samples": 2}).content)
    assert other["seed"] != first["seed"]
    assert other["futures"] != first["futures"]


def test_answer_does_not_depend_on_strangers_or_on_how_many_follow(service: Service):
    mine = {"poses": WALK, "seed": 11, "num_samples": 4, "num_steps": 6}
    alone = orjson.loads(service.post(mine).content)["futures"]
    strangers = [{"poses": WALK, "seed": s, "num_samples": 30, "num_steps": s} for s in range(1, 6)]
    together = service.post_together([*strangers, mine, {**mine, "num_samples": 40}])
    assert orjson.loads(together[-2].content)["futures"] == alone
    assert orjson.loads(together[-1].content)["futures"][:4] == alone


def test_early_stop_is_said(service: Service):
    answer = orjson.loads(service.post({"poses": WALK, "num_steps": 3}).content)
    assert answer["steps"] == {"run": 3, "of": 10, "stopped_by": "num_steps"}


def test_both_paths_answer_alike(service: Service):
    body = {"poses": WALK, "seed": 1, "num_samples": 2}
    first, second = service.post(body), service.post(body, "/v1/predict")
    assert orjson.loads(first.content)["futures"] == orjson.loads(second.content)["futures"]


@pytest.mark.parametrize("model", ["still", "diffusion"])
@pytest.mark.parametrize("shift", [(3.0, -2.0, 0.0), (1e3, 2e4, 0.0), (-1e5, 5e5, 4000.0)])
def test_world_may_be_anywhere(service: Service, model: str, shift: tuple[float, float, float]):
    options = {"model": model, "seed": 3, "num_samples": 2, "bone_lengths": "free"}
    moved = service.futures(WALK + np.array(shift), **options)
    if shift[2] == 0.0:
        here = service.futures(WALK, **options)
        np.testing.assert_allclose(moved - np.array(shift), here, atol=1.5e-4)
    lengths = bone_lengths(service.futures(WALK + shift, model=model), BODY21.parents)
    np.testing.assert_allclose(
        lengths, np.broadcast_to(bone_lengths(WALK[0], BODY21.parents), lengths.shape), atol=1.5e-3
    )


@pytest.mark.parametrize("angle", [0.7, -2.5])
def test_future_turns_with_the_person(service: Service, angle: float):
    options = {"model": "still", "num_samples": 1, "bone_lengths": "free"}
    turned = service.futures(rotate_yaw(WALK, angle), **options)
    expected = rotate_yaw(service.futures(WALK, **options), angle)
    np.testing.assert_allclose(turned, expected, atol=1.5e-4)


def test_y_up_in_millimetres_is_the_same_person(service: Service):
    options = {"seed": 5, "num_samples": 3}
    here = service.futures(WALK, **options)
    y_up_mm = np.ascontiguousarray(WALK[..., [1, 2, 0]]) * 1000.0
    there = service.futures(y_up_mm, axes={"up": "y", "units": "mm"}, **options)
    np.testing.assert_allclose(there[..., [2, 0, 1]] / 1000.0, here, atol=1.5e-4)


# Rotations that take our +Z to the caller's up axis; where the person faces is theirs to choose.
UPRIGHT = {
    "x": [[0, 0, 1], [0, 1, 0], [-1, 0, 0]],
    "-x": [[0, 0, -1], [0, 1, 0], [1, 0, 0]],
    "y": [[1, 0, 0], [0, 0, 1], [0, -1, 0]],
    "-y": [[1, 0, 0], [0, 0, -1], [0, 1, 0]],
    "z": [[0, -1, 0], [1, 0, 0], [0, 0, 1]],
    "-z": [[-1, 0, 0], [0, 1, 0], [0, 0, -1]],
}


@pytest.mark.parametrize("up", sorted(UPRIGHT))
def test_every_up_axis_keeps_the_person_upright_and_unmirrored(service: Service, up: str):
    rotation = np.array(UPRIGHT[up], dtype=float)
    options = {"model": "still", "num_samples": 1}
    there = service.futures(np.ascontiguousarray(WALK @ rotation.T), axes={"up": up}, **options)
    np.testing.assert_allclose(there @ rotation, service.futures(WALK, **options), atol=2e-4)
    axes = Axes(up=up)  # type: ignore[arg-type]
    ours = axes.to_metres(np.eye(3))
    np.testing.assert_allclose(ours @ ours.T, np.eye(3))
    assert np.linalg.det(ours) == pytest.approx(1.0)
    np.testing.assert_allclose(axes.to_metres(rotation @ [0.0, 0.0, 1.0]), [0, 0, 1], atol=1e-12)


@pytest.mark.parametrize("fps", [20.0, 24.0, 25.0, 29.97, 50.0, 60.0, 120.0])
def test_futures_come_at_the_callers_rate(service: Service, fps: float):
    poses = walking(round(fps * 0.6), fps=fps)
    response = service.post({"poses": poses, "fps": fps, "seed": 2, "num_samples": 2})
    answer = orjson.loads(response.content)
    assert (answer["fps"], answer["num_frames"]) == (fps, round(2.0 * fps))
    assert np.shape(answer["futures"]) == (2, round(2.0 * fps), 21, 3)


def test_rates_agree_where_their_frames_coincide(service: Service):
    options = {"seed": 2, "num_samples": 2, "bone_lengths": "free"}
    at_30 = service.futures(walking(15, fps=30.0), fps=30, **options)
    at_60 = service.futures(walking(31, fps=60.0), fps=60, **options)
    np.testing.assert_allclose(at_60[:, 1::2], at_30, atol=2e-4)


def test_longer_observation_uses_its_last_frames(service: Service):
    options = {"seed": 2, "num_samples": 2}
    longer = service.futures(walking(60), **options)
    np.testing.assert_allclose(longer, service.futures(walking(15), **options), atol=2e-4)


@pytest.mark.parametrize("name", sorted(SKELETONS))
@pytest.mark.parametrize("lengths", ["observed", "free"])
def test_nothing_jumps_at_the_first_frame(service: Service, name: str, lengths: str):
    poses = in_skeleton(name)
    still = service.futures(
        poses, skeleton=name, axes=METRES, model="still", num_samples=1, bone_lengths=lengths
    )
    np.testing.assert_allclose(still[0, 0], poses[-1], atol=2e-4 if lengths == "free" else 3e-2)
    np.testing.assert_array_equal(still[0, 0], still[0, -1])


NO_BONES = {  # lines that are drawn, but between which the trunk bends
    "coco17": {"left_shoulder", "right_shoulder", "left_hip", "right_hip"},
    "humaneva15": {"Thorax"},
    "mediapipe33": {"left_shoulder", "right_shoulder", "left_hip", "right_hip"},
}


@pytest.mark.parametrize("name", sorted(SKELETONS))
def test_limbs_do_not_stretch(service: Service, name: str):
    tree, order = SKELETONS[name], list(SENT_ORDERS[name])
    poses, options = in_skeleton(name), {"skeleton": name, "axes": METRES, "num_samples": 10}
    bones = np.array([j not in NO_BONES.get(name, ()) for j in tree.joints[1:]])
    observed = np.median(bone_lengths(poses[:, order], tree.parents), axis=0)[1:]
    futures = service.futures(poses, **options)[:, :, order]
    lengths = bone_lengths(futures, tree.parents)[..., 1:]
    kept = (observed > 0.02) & bones  # a map may put two joints in one place
    stretch = np.abs(lengths.mean(axis=1) - observed)[:, kept] / observed[kept]
    assert stretch.mean() < 5e-4
    jitter = np.abs(np.diff(lengths, axis=1))[..., kept] / observed[kept]
    assert jitter.mean() < 1e-3
    free = service.futures(poses, bone_lengths="free", **options)[:, :, order]
    assert np.abs(bone_lengths(free, tree.parents)[..., 1:] - observed).max() > 0.02


def test_own_names_in_any_order_give_the_same_futures(service: Service):
    order = np.random.default_rng(0).permutation(21)
    joints = [f"j{i}_{BODY21.joints[i]}" for i in order]
    mapping = {f"j{i}_{joint}": joint for i, joint in enumerate(BODY21.joints)}
    options = {"seed": 4, "num_samples": 2}
    response = service.post(
        {
            "poses": np.ascontiguousarray(WALK[:, order]),
            "skeleton": {"joints": joints, "map": mapping},
        }
        | options
    )
    answer = orjson.loads(response.content)
    assert answer["joints"] == joints
    assert answer["skeleton"] == "custom"
    expected = service.futures(WALK, **options)[:, :, order]
    np.testing.assert_allclose(np.array(answer["futures"]), expected, atol=1.5e-4)


def test_joint_that_the_model_does_not_have_stays_on_its_limb(service: Service):
    hand = BODY21.index("left_hand")
    finger = WALK[:, hand] + np.array([0.02, 0.01, -0.09])
    poses = np.concatenate([WALK, finger[:, None]], axis=1)
    futures = service.futures(
        poses, skeleton={"joints": [*BODY21.joints, "left_index_tip"]}, num_samples=3
    )
    reach = np.linalg.norm(futures[:, :, -1] - futures[:, :, hand], axis=-1)
    np.testing.assert_allclose(reach, np.linalg.norm([0.02, 0.01, -0.09]), atol=3e-4)


def test_null_joints_are_filled_and_said(service: Service):
    poses = WALK.tolist()
    poses[3][8] = poses[4][8] = None
    answer = orjson.loads(service.post({"poses": poses, "seed": 1, "num_samples": 2}).content)
    (warning,) = answer["warnings"]
    assert "left_hand is null in 2 of the last 15 frames" in warning
    filled = service.futures(WALK, seed=1, num_samples=2)
    assert np.abs(np.array(answer["futures"]) - filled).max() < 0.01


def test_joint_never_seen_is_estimated_and_said(service: Service):
    poses = WALK.tolist()
    for frame in poses:
        frame[BODY21.index("left_toes")] = None
    answer = orjson.loads(service.post({"poses": poses, "seed": 1, "num_samples": 2}).content)
    assert any("left_toes is null in every frame" in warning for warning in answer["warnings"])
    assert np.isfinite(np.array(answer["futures"], dtype=float)).all()


def test_models_and_skeletons_are_listed(service: Service):
    listed = service.get("/models").json()
    assert listed["default"] == "diffusion"
    assert [model["name"] for model in listed["models"]] == ["diffusion", "still"]
    detail = service.get("/models/diffusion").json()
    assert detail["state"] == "ready"
    assert detail["card"] == "# A tiny bundle\n"
    assert (detail["fps"], detail["num_observed"], detail["horizon"], detail["num_steps"]) == (
        30, 15, 60, 10,
    )  # fmt: skip
    names = [skeleton["name"] for skeleton in service.get("/skeletons").json()["skeletons"]]
    assert sorted(names) == sorted(SKELETONS)


def test_health_is_told(service: Service):
    assert service.get("/livez").json() == {"status": "alive"}
    ready = service.get("/readyz")
    assert ready.status_code == 200
    assert ready.json()["models"] == {"diffusion": "ready", "still": "ready"}
    digests = ready.json()["golden_digests"]
    assert set(digests) == {"diffusion", "still"}
    assert digests["diffusion"] != digests["still"]


def test_documents_declare_every_error(service: Service):
    assert service.get("/docs").status_code == 200
    document = service.get("/openapi.json").json()
    responses = document["paths"]["/predict"]["post"]["responses"]
    assert set(responses) == {
        "200", "400", "401", "406", "409", "413", "415", "422", "429", "500", "503", "504",
    }  # fmt: skip
    for status, response in responses.items():
        media_type = "application/json" if status == "200" else "application/problem+json"
        assert media_type in response["content"]
    assert set(responses["200"]["content"]) == {
        "application/json", "application/msgpack", "application/x-npz", "text/event-stream",
        "application/x-ndjson", "model/bvh", "model/gltf-binary", "application/zip",
    }  # fmt: skip
    assert "Problem" in document["components"]["schemas"]
    assert set(document["paths"]["/requests/{request_id}"]["delete"]["responses"]) >= {
        "204", "401", "404",
    }  # fmt: skip


def test_example_of_the_documents_works(service: Service):
    document = service.get("/openapi.json").json()
    (example,) = document["components"]["schemas"]["PredictRequest"]["examples"]
    assert service.post(example).status_code == 200


def test_equal_requests_of_equal_ids_have_equal_bytes(service: Service):
    body = dumped({"poses": WALK, "seed": 8, "num_samples": 3})
    headers = JSON | {"x-request-id": "mine.1"}
    first, again = (
        service.request("POST", "/predict", content=body, headers=headers) for _ in range(2)
    )
    assert first.headers["x-request-id"] == "mine.1"
    assert orjson.loads(first.content)["id"] == "mine.1"
    assert untimed(first.content) == untimed(again.content)


@pytest.mark.parametrize("asked", ["", "with space", "x" * 65, "a\u00e9"])
def test_id_that_is_not_well_formed_is_replaced(service: Service, asked: str):
    headers = {"x-request-id": asked.encode("latin-1")}
    made = service.request("GET", "/livez", headers=headers).headers["x-request-id"]
    assert re.fullmatch(r"[0-9a-f-]{36}", made)


def test_every_answer_has_an_id_even_that_there_is_none(service: Service):
    for path in ("/models", "/nowhere", "/predict"):
        assert service.get(path).headers["x-request-id"]


@pytest.mark.parametrize("fps", [30.0, 50.0])
def test_horizon_may_be_shorter_or_longer_and_longer_is_said(service: Service, fps: float):
    poses = walking(round(fps * 0.6), fps=fps)
    options = {"poses": poses, "fps": fps, "seed": 3, "num_samples": 2}
    usual = orjson.loads(service.post(options).content)
    for seconds, warns in ((0.5, False), (2.0, False), (5.0, True)):
        answer = orjson.loads(service.post(options | {"horizon_s": seconds}).content)
        assert answer["num_frames"] == round(seconds * fps)
        assert np.shape(answer["futures"]) == (2, answer["num_frames"], 21, 3)
        assert bool(answer["warnings"]) == warns
        common = min(answer["num_frames"], usual["num_frames"]) - 1  # the last may be resampled
        np.testing.assert_allclose(
            np.array(answer["futures"])[:, :common],
            np.array(usual["futures"])[:, :common],
            atol=3e-3,
        )
    assert "was made for 2 s; from there to 5 s" in answer["warnings"][0]


def test_settled_futures_stop_early_and_say_so(service: Service):
    answer = orjson.loads(service.post({"poses": WALK, "seed": 1, "tolerance_m": 100.0}).content)
    assert answer["steps"]["stopped_by"] == "tolerance"
    assert answer["steps"]["run"] < answer["steps"]["of"] == 10


def test_deadline_that_is_far_changes_nothing(service: Service):
    options = {"poses": WALK, "seed": 1, "num_samples": 2}
    relaxed = orjson.loads(service.post(options | {"deadline_ms": 1e6}).content)
    assert relaxed["steps"] == {"run": 10, "of": 10, "stopped_by": "end"}
    assert relaxed["futures"] == orjson.loads(service.post(options).content)["futures"]


@pytest.mark.parametrize("where", ["body", "header"])
def test_smaller_of_two_deadlines_counts(service: Service, where: str):
    short = {"body": 1e-6, "header": "1000"} if where == "body" else {"body": 1e6, "header": "1e-9"}
    body = dumped({"poses": WALK, "deadline_ms": short["body"]})
    headers = JSON | {"x-request-timeout-seconds": str(short["header"])}
    response = service.request("POST", "/predict", content=body, headers=headers)
    assert (response.status_code, response.json()["type"]) == (504, "/problems/deadline-too-short")


@pytest.mark.parametrize("asked", ["soon", "0", "-1", "nan", "inf"])
def test_timeout_header_that_is_no_time_is_refused(service: Service, asked: str):
    headers = JSON | {"x-request-timeout-seconds": asked}
    body = dumped({"poses": WALK})
    response = service.request("POST", "/predict", content=body, headers=headers)
    problem = response.json()
    assert (response.status_code, problem["type"]) == (422, "/problems/invalid-field")
    assert problem["pointer"] == "/header/X-Request-Timeout-Seconds"
    assert asked in problem["found"]


def test_modes_share_out_the_futures(service: Service):
    options = {"poses": WALK, "seed": 2, "num_samples": 12}
    answer = orjson.loads(
        service.post(options | {"return": ["futures", "modes"], "num_modes": 3}).content
    )
    modes = answer["modes"]
    assert len(modes) == 3
    assert sum(mode["probability"] for mode in modes) == pytest.approx(1.0)
    assert sorted(chain(*(mode["members"] for mode in modes))) == list(range(12))
    assert all(mode["sample"] in mode["members"] for mode in modes)
    alone = orjson.loads(service.post(options | {"return": ["modes"], "num_modes": 3}).content)
    assert (alone["modes"], alone.get("futures")) == (modes, None)


@pytest.mark.parametrize("units", ["m", "mm"])
def test_quantiles_are_in_the_callers_order_axes_and_units(service: Service, units: str):
    order = np.random.default_rng(1).permutation(21)
    scale = {"m": 1.0, "mm": 1000.0}[units]
    y_up = np.ascontiguousarray(WALK[:, order][..., [1, 2, 0]]) * scale
    options = {"seed": 2, "num_samples": 30, "return": ["futures", "quantiles"],
               "quantile_levels": [0.5, 0.9]}  # fmt: skip
    joints = [BODY21.joints[i] for i in order]
    answer = orjson.loads(
        service.post({"poses": y_up, "axes": {"up": "y", "units": units},
                      "skeleton": {"joints": joints}} | options).content
    )  # fmt: skip
    quantiles = answer["quantiles"]
    futures, centre = np.array(answer["futures"]), np.array(quantiles["centre"])
    np.testing.assert_allclose(centre, futures.mean(axis=0), atol=2e-4 * scale)
    radius = np.array(quantiles["radius"])
    assert radius.shape == (2, 60, 21)
    assert (radius[1] >= radius[0]).all()
    distances = np.linalg.norm(futures - centre, axis=-1)
    inside = (distances[:, None] <= radius + 2e-4 * scale).mean(axis=0)  # (L, H, J)
    assert (inside[0] >= 0.5).all()
    assert (inside[1] >= 0.9).all()
    assert (inside[0] <= 0.6).mean() > 0.9


def test_limits_are_told(service: Service):
    limits = service.get("/limits").json()
    assert limits["max_samples"] == 200
    assert limits["rate_limit"] is None
    schemas = service.get("/openapi.json").json()["components"]["schemas"]
    fields = schemas["PredictRequest"]["properties"]
    assert fields["num_samples"]["maximum"] == limits["max_samples"]
    assert fields["poses"]["maxItems"] == limits["max_frames"]
    assert fields["horizon_s"]["anyOf"][0]["maximum"] == limits["max_horizon_s"]
