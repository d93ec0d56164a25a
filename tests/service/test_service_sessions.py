from asyncio import Event

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from models.motion.axes import Axes
from service.errors import FieldError
from service.sessions import FRAMES_PER_PERIOD, GAP_S, History, Session, Sessions, Watch

FPS, NUM_FRAMES = 30.0, 15
WATCH = Watch(joints=("hips", "head"), axes=Axes(), fps=FPS, num_frames=NUM_FRAMES)


def pose(t: float) -> np.ndarray:
    """Joints that move along lines, one of them fast."""
    return np.array([[t, 2.0 * t, 1.0], [-30.0 * t, 0.0, 2.0 + t]])


def filled(times: list[float]) -> History:
    history = History(fps=FPS, num_frames=NUM_FRAMES)
    for t in times:
        history.add(t, pose(t))
    return history


spacings = st.lists(st.floats(1e-4, 0.9 * GAP_S), min_size=1, max_size=200)


@settings(deadline=None)
@given(spacings, st.floats(-100.0, 100.0))
def test_even_motion_is_seen_evenly_however_uneven_its_frames_are(gaps: list[float], start: float):
    history = filled((start + np.cumsum(gaps)).tolist())
    poses = history.poses()
    newest = history.newest_s or 0.0
    moments = newest - np.arange(len(poses) - 1, -1, -1) / FPS
    np.testing.assert_allclose(poses, [pose(t) for t in moments], atol=1e-6)
    assert len(poses) <= NUM_FRAMES + 1
    assert history.suffices == (len(poses) >= NUM_FRAMES)


@settings(deadline=None)
@given(spacings)
def test_so_many_frames_are_kept_and_no_more(gaps: list[float]):
    history = filled(np.cumsum(gaps).tolist())
    most = 2 * FRAMES_PER_PERIOD * (NUM_FRAMES + 1) + 3
    assert len(history.frames) <= most
    assert history.newest_s == pytest.approx(np.sum(gaps))


def test_a_flood_of_frames_is_thinned_and_the_latest_is_there():
    history = filled([i / 20_000.0 for i in range(20_000)])
    assert len(history.frames) < 2 * FRAMES_PER_PERIOD * (NUM_FRAMES + 2)
    np.testing.assert_array_equal(history.poses()[-1], pose(19_999 / 20_000.0))


def test_frames_at_the_rate_are_taken_as_they_are():
    rng = np.random.default_rng(0)
    poses = rng.normal(size=(40, 2, 3))
    poses[30, 1] = np.nan
    history = History(fps=FPS, num_frames=NUM_FRAMES)
    for i, frame in enumerate(poses):
        history.add(1e6 + i / FPS, frame)
    np.testing.assert_array_equal(history.poses(), poses[-NUM_FRAMES - 1 :])


def test_a_joint_that_one_neighbour_lacks_was_not_seen_between_them():
    history = History(fps=FPS, num_frames=2)
    lacking = pose(0.05)
    lacking[1] = np.nan
    for t, frame in ((0.0, pose(0.0)), (0.05, lacking), (0.1, pose(0.1))):
        history.add(t, frame)
    seen = np.isfinite(history.poses()[:, :, 0])
    np.testing.assert_array_equal(seen[-2:], [[True, False], [True, True]])


def test_a_single_frame_is_itself():
    np.testing.assert_array_equal(filled([3.0]).poses(), [pose(3.0)])


def test_a_frame_must_be_later_than_the_last():
    history = filled([1.0, 1.1])
    for t in (1.1, 1.05):
        with pytest.raises(FieldError, match=r"t: found 1\.\S+ s; must be after the last, at 1.1"):
            history.add(t, pose(t))
    assert history.newest_s == 1.1


@pytest.mark.parametrize("t", [1.1 + 2 * GAP_S, -50.0])
def test_a_time_far_from_the_last_begins_anew(t: float):
    history = filled([1.0, 1.1])
    history.add(t, pose(t))
    assert [seen for seen, _ in history.frames] == [t]


def seen_by(sessions: Sessions, session_id: str | None = None) -> Session:
    return sessions.open(session_id, watch=WATCH, taken=Event())


def test_sessions_that_were_left_are_kept_for_a_while():
    now = 0.0
    sessions = Sessions(most=8, kept_s=30.0, clock=lambda: now)
    session = seen_by(sessions)
    session.history.add(1.0, pose(1.0))
    now = 1000.0
    sessions.leave(session)
    now = 1029.0
    again = seen_by(sessions, session.id)
    assert (again.id, len(again.history.frames)) == (session.id, 1)
    sessions.leave(again)
    now = 1060.0
    assert seen_by(sessions, session.id).id != session.id


def test_so_many_sessions_are_kept_the_latest_left():
    sessions = Sessions(most=2)
    opened = [seen_by(sessions) for _ in range(4)]
    held = seen_by(sessions)
    for session in opened:
        sessions.leave(session)
    known = {session.id for session in (*opened, held)}
    found = [seen_by(sessions, session.id).id in known for session in (*opened, held)]
    assert found == [False, False, True, True, True]


def test_whoever_has_a_session_is_told_that_it_is_taken():
    sessions = Sessions(most=2)
    session = seen_by(sessions)
    taken = session.taken
    assert taken is not None
    other = seen_by(sessions, session.id)
    assert taken.is_set()
    assert other.taken is not None
    assert not other.taken.is_set()
