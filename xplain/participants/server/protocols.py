"""Which protocol runs what: the one place where the server's protocols are named."""

from __future__ import annotations

from xplain.collect.protocol.plan import Collection
from xplain.participants.server.collect_protocol import CollectProtocol
from xplain.participants.server.protocol import Protocol
from xplain.participants.server.study_protocol import StudyProtocol
from xplain.study.protocol.plan import Study

Running = Study | Collection
"""What a store can run."""


def protocol_of(running: Running) -> Protocol:
    """The protocol of a plan at work."""
    return CollectProtocol(running) if isinstance(running, Collection) else StudyProtocol(running)
