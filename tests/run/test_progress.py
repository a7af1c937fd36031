"""How long a run still takes, as it is told while it goes."""

import pytest

from calstudy.run import progress

COSTS = {str(number): 10.0 for number in range(36)}
"""Of a run that is planned to take 360 s, and 180 s with two workers."""


def forecasts(monkeypatch, pace: float, startup: float, workers: int = 2) -> list[tuple[float, float]]:
    """Return after each task the seconds that are told to be left, and those that are; workers end at the same time."""
    now = 0.0
    monkeypatch.setattr(progress.time, "perf_counter", lambda: now)
    forecast, total = progress.Forecast(COSTS, workers), startup + pace * sum(COSTS.values()) / workers
    found = []
    for number, (key, cost) in enumerate(COSTS.items(), 1):
        now = startup + pace * cost * number / workers
        found.append((forecast.finish(key), total - now))
    return found


def test_the_start_of_workers_does_not_count_as_their_pace(monkeypatch):
    # What was told before was the elapsed time over the part that is made: 900 s after the first task.
    for told, left in forecasts(monkeypatch, 1, 20)[:-1]:
        assert left <= told < 1.4 * left


@pytest.mark.parametrize("pace", [0.3, 3])
def test_the_pace_is_learned(monkeypatch, pace):
    halfway = forecasts(monkeypatch, pace, 0)[17]
    # A minute as planned and a minute and a half at the true pace: weights of 2 and 3.
    assert halfway[0] == pytest.approx(halfway[1] * (60 + 90 * pace) / (150 * pace))
    assert forecasts(monkeypatch, pace, 0)[-1] == (0, 0)


def test_the_part_that_is_made_is_that_of_the_costs(monkeypatch):
    forecast = progress.Forecast({"long": 90.0, "short": 10.0}, 1)
    forecast.finish("long")
    assert forecast.fraction == pytest.approx(0.9)
