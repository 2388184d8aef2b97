"""What every column of the exported tables means."""

CODEBOOK = {
    "participants": {
        "participant": "random id; the key of every table",
        "stream": "person, pilot or bot; decided by the invitation, never changed",
        "entry": "invitation, prolific or open",
        "stage": "where they are or how it ended: done, declined, ineligible, withdrawn, timed_out",
        "type": "user type whose knowledge they were given",
        "condition": "explanation technique",
        "eligibility_attempts": "eligibility tests taken",
        "eligible": "1 if the test was passed",
        "steps_labelled": "steps of the trace with a label",
        "messages_given": "messages that the robot gave (of the policy, until the last step)",
        "inexplicable_transitions": "labels 'makes no sense' at the last step, 0 … m; paper: "
        "measure 2",
        "quiz_score": "statements judged correctly, 0 … 4; paper: measure 3",
        "interaction_time_s": "seconds, server's wall clock, first rendering of step 1 to the "
        "last accepted label; paper: measure 1",
        "interaction_time_monotonic_s": "the same by the server's monotonic clock; empty if the "
        "machine was restarted in between",
        "hidden_s": "seconds of it in which no page of the study was visible (browser's clock); "
        "empty without JavaScript",
        "visible_time_s": "interaction_time_s less hidden_s",
        "entered": "server's wall clock, seconds since 1970-01-01 UTC",
        "last_seen": "server's wall clock, seconds since 1970-01-01 UTC",
        "consent_hash": "SHA-256 of the consent text agreed to (or declined)",
        "timed_out": "times that they were silent for too long, and came back or not",
        "window_width": "of the window at the consent, CSS pixels; empty without JavaScript",
        "attention_missed": "attention checks after the quiz that were answered wrongly",
        "completion_code": "of those who finished; letters only",
        "outside_ids": "ids of the recruiting platform (JSON), only if the config keeps them",
    },
    "steps": {
        "participant": "key",
        "k": "step of the evaluation, 0 … m − 1",
        "transition": "what the robot did, as shown",
        "given_before": "messages on the page before this step, joined by ;",
        "messages": "messages that were new at this step, joined by ;",
        "belief_before": "probability of each user type (JSON list), before the step",
        "belief_after": "the same after the labels of the step",
        "action_values": "the policy's value of each next message set (JSON, bitmask: value; "
        "0 = explain at once; larger is better)",
        "labels": "labels of transitions 0 … k (JSON list), 1 = makes sense",
        "seconds": "from the first rendering of the step to its accepted labels, server's clock",
    },
    "pages": {
        "participant": "key",
        "sequence": "number of the answer that the page was for",
        "stage": "which page",
        "step": "k, of the evaluation's pages",
        "shown": "first rendering, server's wall clock, seconds since 1970-01-01 UTC",
        "seconds": "until its answer was accepted, server's clock; empty if it never was",
        "browser_ms": "the same by the page's performance.now when the answer was sent",
    },
    "labels": {
        "participant": "key",
        "k": "step at which the label was given",
        "i": "transition that was labelled, 0 … k",
        "transition": "what the robot did, as shown",
        "messages_shown": "all messages on the page, joined by ;",
        "label": "1 = makes sense, 0 = makes no sense",
    },
    "eligibility": {
        "participant": "key",
        "attempt": "1, 2, …",
        "fact": "parameter asked about",
        "question": "as shown",
        "answer": "as chosen",
        "correct": "1 if it is what the participant had been told",
    },
    "quiz": {
        "participant": "key",
        "fact": "parameter that the statement is about",
        "statement": "as shown",
        "true": "1 if it is true of the robot",
        "ticked": "1 if the participant ticked it",
        "correct": "1 if ticked = true",
    },
    "answers": {
        "participant": "key",
        "question": "name in the configuration",
        "answer": "as given; empty if left out",
    },
    "events": {
        "participant": "key",
        "sequence": "order of arrival at the server, 0, 1, …",
        "source": "protocol (answers), server, shown (first renderings), tab:… (a page's reports)",
        "source_sequence": "order at the source",
        "kind": "of the event",
        "wall": "server's wall clock, seconds since 1970-01-01 UTC",
        "monotonic": "server's monotonic clock, seconds; comparable where boot is the same",
        "boot": "id of the machine's boot",
        "browser": "the page's performance.now, milliseconds since the page began to load",
        "number": "order of arrival of all participants' events",
        "content": "hash of the event (xplain/people/analysis/log.py)",
        "digest": "hash of the event and all before it",
        "payload": "JSON; of a tab: at = browser's wall clock in ms, what = detail",
    },
    "codebook": {
        "table": "name of the file",
        "column": "name of the column",
        "type": "text, whole number, number or JSON",
        "unit": "s, ms or px; empty where there is none",
        "meaning": "this text",
    },
}

_WHOLE = {
    *("eligibility_attempts", "eligible", "steps_labelled", "messages_given", "attempt", "true"),
    *("inexplicable_transitions", "quiz_score", "timed_out", "window_width", "attention_missed"),
    *("k", "i", "label", "step", "sequence", "source_sequence", "number", "correct", "ticked"),
}
_JSON = {"belief_before", "belief_after", "action_values", "labels", "payload", "outside_ids"}
_UNITS = {
    "s": {"entered", "last_seen", "shown", "seconds", "wall", "monotonic"},
    "ms": {"browser", "browser_ms"},
    "px": {"window_width"},
}


def unit_of(column: str) -> str:
    """The unit of a column's numbers; "" where they have none."""
    own = [unit for unit, columns in _UNITS.items() if column in columns]
    return own[0] if own else "s" if column.endswith("_s") else ""


def kind_of(column: str) -> str:
    """What a column holds."""
    if column in _WHOLE:
        return "whole number"
    if column in _JSON:
        return "JSON"
    return "number" if unit_of(column) else "text"
