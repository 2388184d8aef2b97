"""Planning tasks in PDDL as domains: what the robot plans with, and what people believe about it.

    reading ── Task ── changes ── grounding ── states ── domain.PDDL

``reading`` parses files with unified-planning, which no other module here uses. A fact that
people may hold wrong is a list of ``changes`` of the robot's task, written in YAML or found by
comparing two tasks. Every believed task is grounded into the same actions and the same states.
"""
