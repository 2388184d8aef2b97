"""Serves the user study: ``xplain study port=8080 rules.per_cell=10``.

The first start fixes the study in its database; later starts go on with it. One worker process
with threads: it alone has the database open. How a lab runs a study: docs/study.md.
"""

from functools import partial

from xplain.cli import people

main = partial(people.serve, "study")
