"""Planning tasks in PDDL as domains: the robot's task, and people's beliefs about it.

    translator ── Task ── facts ── beliefs ── domain.PDDL

``translator`` reads files with Fast Downward's translator, which no other module here uses. A fact
that people may believe incorrectly changes items of the robot's task. The changes are written in
YAML or found by comparing two tasks. All beliefs share the ground actions and the states.
"""
