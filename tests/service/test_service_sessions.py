from asyncio import Event

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from models.motion.axes import Axes
from models.motion.gaps import num_even
from service.errors import FieldError
from service.live.sessions import FRAMES_PER_PERIOD, GAP_S, Frame, History, Session, Sessions, Watch

FPS, NUM_FRAMES = 30.0, 15
WATCH = Watch(joints=("hips", "head"), axes=Axes(), fps=FPS, num_frames=NUM_FRAMES)


def pose(t: float) -> np.ndarray:
    """Joints that move along lines, one of them fast."""
    return np.array([[t, 2.0 * t, 1.0], [-30.0 * t, 0.0, 2.0 + t]])


def frame(t: float, confidence: np.ndarray | None = None) -> Frame:
    return Frame(t=t, pose=pose(t), confidence=confidence)


def filled(times: list[float]) -> History:
    return History(fps=FPS, num_frames=NUM_FRAMES, frames=[frame(t) for t in times])


spacings = st.lists(st.floats(1e-4, 0.9 * GAP_S), min_size=1, max_size=200)


@given(spacings, st.floats(-100.0, 100.0))
def test_it_suffices_when_what_is_kept_spans_what_a_request_needs(gaps: list[float], start: float):
    times = start + np.cumsum(gaps)
    seen = times[times >= times[-1] - (NUM_FRAMES + 1) / FPS]
    assert filled(times.tolist()).suffices == (num_even(times[-1] - times[0], FPS) >= NUM_FRAMES)
    kept = filled(times.tolist()).observed()["timestamps"]
    assert kept[-1] == times[-1]
    assert kept[0] <= seen[0]


@given(spacings)
def test_so_many_frames_are_kept_and_no_more(gaps: list[float]):
    history = filled(np.cumsum(gaps).tolist())
    most = 2 * FRAMES_PER_PERIOD * (NUM_FRAMES + 1) + 3
    assert len(history.frames) <= most
    assert history.newest_s == pytest.approx(np.sum(gaps))


def test_a_flood_of_frames_is_thinned_and_the_latest_is_there():
    history = filled([i / 20_000.0 for i in range(20_000)])
    assert len(history.frames) < 2 * FRAMES_PER_PERIOD * (NUM_FRAMES + 2)
    np.testing.assert_array_equal(history.observed()["poses"][-1], pose(19_999 / 20_000.0))


def test_frames_are_the_fields_of_a_request_as_they_came():
    rng = np.random.default_rng(0)
    times = 1e6 + np.arange(17) / FPS + rng.uniform(0.0, 0.01, 17)
    poses = rng.normal(size=(17, 2, 3))
    poses[10, 1] = np.nan
    frames = [Frame(t=t, pose=seen) for t, seen in zip(times.tolist(), poses, strict=True)]
    observed = History(fps=FPS, num_frames=NUM_FRAMES, frames=frames).observed()
    np.testing.assert_array_equal(observed["poses"], poses)
    assert observed["timestamps"] == times.tolist()
    assert observed["confidence"] is None


def test_a_frame_that_tells_no_confidence_is_sure():
    history = filled([1.0])
    history.add(frame(1.1, np.array([0.2, 0.9])))
    history.add(frame(1.2))
    expected = [[1.0, 1.0], [0.2, 0.9], [1.0, 1.0]]
    np.testing.assert_array_equal(history.observed()["confidence"], expected)


def test_a_frame_must_be_later_than_the_last():
    history = filled([1.0, 1.1])
    for t in (1.1, 1.05):
        with pytest.raises(FieldError, match=r"t: found 1\.\S+ s; must be after the last, at 1.1"):
            history.add(frame(t))
    assert history.newest_s == 1.1


@pytest.mark.parametrize("t", [1.1 + 2 * GAP_S, -50.0])
def test_a_time_far_from_the_last_begins_anew(t: float):
    history = filled([1.0, 1.1])
    history.add(frame(t))
    assert [seen.t for seen in history.frames] == [t]


def seen_by(sessions: Sessions, session_id: str | None = None) -> Session:
    return sessions.open(session_id, watch=WATCH, taken=Event())


def test_sessions_that_were_left_are_kept_for_a_while():
    now = 0.0
    sessions = Sessions(most=8, kept_s=30.0, clock=lambda: now)
    session = seen_by(sessions)
    session.history.add(frame(1.0))
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
