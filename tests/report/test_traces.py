"""Which explanation a picture shows."""

from xplain.report.traces import Story, telling


def story(trace: int, user: str, *said: tuple[str, ...]) -> Story:
    labels = tuple((1,) * (k + 1) for k in range(len(said)))
    phrases = ("moves",) * len(said)
    return Story("solver", trace, user, 0.0, phrases, (), said, labels)


def test_the_trace_whose_users_are_told_the_most_different_things_is_shown() -> None:
    nothing = [story(0, user, (), ()) for user in "AB"]
    alike = [story(1, user, ("fire", "fence"), ()) for user in "AB"]
    differ = [story(2, "A", (), ()), story(2, "B", ("fire",), ("fence",)), story(2, "C", ("fire",))]
    assert telling([*nothing, *alike, *differ]) == [differ[1], differ[0]]
    assert telling([*nothing, *alike])[0] is alike[0]


def test_a_lone_story_is_the_one() -> None:
    only = story(0, "A", ("fire",))
    assert telling([only]) == [only]
    assert telling([]) == []
