"""Planning tasks in PDDL as domains: the robot's task, and people's beliefs about it.

    task ── facts ── grounding ── domain.PDDL

``task`` reads files with Fast Downward's translator, which no other module here imports. A fact
that people may believe incorrectly changes items of the robot's task. The changes are written in
YAML or found by comparing two tasks. All beliefs share the ground actions and the states.
"""
