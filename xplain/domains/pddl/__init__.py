"""Planning tasks in PDDL as domains: what the robot plans with, and what people believe of it.

    reading ── Task ── changes ── grounding ── states ── domain.PDDL

``reading`` parses files with unified-planning, and nothing else here knows of it. A fact that
people may hold wrong is a list of ``changes`` of the robot's task, written in YAML or found by
comparing two tasks. Every believed task is grounded into the same actions and the same states.
"""
