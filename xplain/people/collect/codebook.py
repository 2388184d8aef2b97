"""What every column of the exported tables means."""

CODEBOOK = {
    "labels": {
        "observer": "who answered; the key of observers.csv",
        "messages": "what they had been told on that page, joined by ;",
        "label": "1 = the step made sense to them, 0 = it did not",
        "…": "every other column is a feature of the robot's step",
    },
    "observers": {
        "observer": "random id",
        "stream": "person, pilot or bot; decided by the invitation, never changed",
        "stage": "where they are or how it ended: done, declined, withdrawn, timed_out",
        "in_labels": "1 if their labels are in labels.csv (or labels_STREAM.csv)",
        "left_out": "why not: unfinished, withdrawn, timed_out, declined, or inattentive (the "
        "obvious step made sense to them)",
        "labels": "number of their labels",
        "cannot_tell": "steps of which they could not tell whether they make sense",
        "attentive": "1 if the obvious step made no sense to them; empty if it was not reached",
        "consistency": "share of the labels of repeated questions that were as before, 0 … 1",
        "likeliest": "facts that they most probably hold wrong, by their own answers, joined by ;",
        "posterior": "probability of that, 0 … 1",
        "unlike": "probability that none of the hypotheses fits them, 0 … 1",
        "role": "whose briefing they got; empty for people as they are",
        "clips_s": "seconds from the first clip's page to the last clip's answer, server's clock",
        "clock": "by which that is: monotonic, or wall where the machine was restarted in between; "
        "impossible where the wall clock was set back, and the time is left out",
        "label_s": "median seconds a label, page shown to answer, server's clock",
        "fast_pages": "pages answered in less than a second a step, which nobody can have read",
        "practice_errors": "answers of the practice that were not as expected",
        "entered": "server's wall clock, seconds since 1970-01-01 UTC",
        "entry": "invitation, platform, open or preview",
        "consent_hash": "SHA-256 of the consent text agreed to (or declined)",
        "stated_…": "of each fact what they say they thought: accurate, inaccurate or unsure",
        "answer_…": "answers to the lab's own questions, as given; a text that a spreadsheet would "
        "run is preceded by '",
    },
    "clips": {
        "observer": "key",
        "number": "order on their pages, 1, 2, …",
        "purpose": "question, repeat (of an earlier question) or attention (the obvious step); at "
        "the end told (the messages hold from then on), later (its step with nothing said), again "
        "(said again)",
        "steps": "what the robot did, as shown, joined by |",
        "messages": "what they were told on the page, joined by ;",
        "labels": "1 = made sense, 0 = did not, 2 = they cannot tell; one a step, joined by ;",
        "bits": "information that the answer was expected to give about what they hold wrong",
        "seconds": "page shown to answer, server's clock",
        "browser_ms": "milliseconds since the page began to load, browser's clock; empty without "
        "JavaScript",
    },
}
