"""What every column of the exported tables means."""

_COMPARISON = {
    "measure": "of participants.csv",
    "n_…": "participants, by condition",
    "mean_…": "by condition",
    "sd_…": "standard deviation, by condition",
    "student_…": "t, df, p of Student's test; p_holm corrected for the three measures",
    "welch_…": "t, df, p of Welch's test",
    "hedges_g": "standardized difference, the first condition less the second",
    "g_low": "lower end of its 95 % interval",
    "g_high": "upper end",
    "permutation_p": "of a permutation test within types",
}

CODEBOOK = {
    "participants": {
        "participant": "random id; the key of every table",
        "stream": "person, pilot or bot; decided by the invitation, never changed",
        "entry": "invitation, platform, open or preview",
        "stage": "where they are or how it ended: done, declined, ineligible, withdrawn, timed_out",
        "type": "user type whose knowledge they were given",
        "condition": "explanation technique",
        "eligibility_attempts": "eligibility tests taken",
        "eligible": "1 if the test was passed",
        "steps_labelled": "steps of the trace with a label",
        "messages_given": "messages that the robot gave (of the policy, until the last step), each "
        "counted once",
        "inexplicable_transitions": "labels 'makes no sense' at the last step, 0 … m; paper: "
        "measure 2",
        "cannot_tell": "transitions of which they could not tell, at the last step",
        "quiz_score": "statements judged correctly, 0 … 4; paper: measure 3",
        "interaction_time_s": "seconds, server's clock, first rendering of step 1, or of a "
        "question before it, to the last accepted label; paper: measure 1",
        "clock": "by which that is: monotonic, or wall where the machine was restarted in between; "
        "impossible where the wall clock was set back, and the time is left out",
        "hidden_s": "seconds of it in which no page of the study was visible (browser's clock); "
        "empty without JavaScript",
        "visible_time_s": "interaction_time_s less hidden_s",
        "entered": "server's wall clock, seconds since 1970-01-01 UTC",
        "last_seen": "server's wall clock, seconds since 1970-01-01 UTC",
        "consent_hash": "SHA-256 of the consent text agreed to (or declined)",
        "timed_out": "times that they were silent for too long, and came back or not",
        "window_width": "of the window at the consent, CSS pixels; empty without JavaScript",
        "attention_missed": "attention checks after the quiz that were answered wrongly",
        "messages_again…": "how often it said one of the messages again; only where it may",
        "questions_asked…": "steps that they were asked about in between; only where a condition "
        "asks",
        "cost…": "λ · messages + inexplicable labels of all steps + κ · questions, as the plan has "
        "these costs; what the policies plan for; only where a condition asks",
    },
    "steps": {
        "participant": "key",
        "k": "step of the evaluation, 0 … m − 1",
        "transition": "what the robot did, as shown",
        "given_before": "messages on the page before this step, joined by ;",
        "messages": "messages that were said at this step, for the first time or again, joined by "
        ";",
        "belief_before": "probability of each user type (JSON list), before the step",
        "belief_after": "the same after the labels of the step",
        "action_values": "the policy's value of each next message set (JSON, bitmask: value; "
        "0 = explain at once; larger is better)",
        "labels": "labels of transitions 0 … k (JSON list), as in the table of labels",
        "seconds": "from the first rendering of the step to its accepted labels, server's clock",
    },
    "pages": {
        "participant": "key",
        "sequence": "number of the answer that the page was for",
        "stage": "which page",
        "step": "k, of the evaluation's pages; of a question that of the step after it",
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
        "label": "1 = makes sense, 0 = makes no sense, 2 = they cannot tell",
    },
    "questions": {
        "participant": "key",
        "number": "0, 1, … of the participant's questions",
        "k": "step of the evaluation that came next",
        "clip": "number of the step asked about, in the plan's list of clips",
        "transition": "what the robot does in it, as shown",
        "situation": "what is so before it, as shown; may be empty",
        "messages_shown": "all messages on the page, joined by ;",
        "worth": "by how much the policy expected the question to lower cost (discounted, the "
        "question's own cost taken off); empty where the policy does not tell",
        "belief_before": "probability of each user type (JSON list), before the answer",
        "belief_after": "the same after it; empty if it was not answered",
        "label": "as in the table of labels; empty if it was not answered",
        "seconds": "from the first rendering of the page to its accepted answer, server's clock",
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
    "table2": _COMPARISON | {"paper_…": "what the paper has there"},
    "asking": _COMPARISON,
    "flow": {
        "stage": "reached, or how it ended; then reasons of leaving somebody out",
        "all": "participants",
        "conformant": "of that condition",
        "personalized": "of that condition",
        "asking…": "of that condition, where there is one",
    },
    "answers": {
        "participant": "key",
        "question": "name in the configuration",
        "answer": "as given; empty if left out",
    },
}
