-- One study or collection, one file. Events are the only state: each has the state that it led to,
-- with what was decided. Where everybody is, who holds which place, and every table of an export
-- follow from them. Events are never changed; only the erasure of a participant overwrites theirs.
CREATE TABLE meta (key TEXT PRIMARY KEY, value TEXT NOT NULL) STRICT;   -- the plan; whether paused


CREATE TABLE participant (
    number INTEGER PRIMARY KEY,
    id TEXT NOT NULL UNIQUE,            -- random; in every table of an export
    stream TEXT NOT NULL CHECK (stream IN ('person', 'pilot', 'bot')),
    entry TEXT NOT NULL,                -- invitation, platform, open or preview
    external TEXT UNIQUE,               -- keyed hash of the outside id, against second entries
    session TEXT,                       -- keyed hash of the last outside session before the consent
    kept TEXT NOT NULL,                 -- outside ids in clear, where the config keeps them (JSON)
    code TEXT NOT NULL,                 -- completion code
    erased INTEGER NOT NULL DEFAULT 0
) STRICT;

CREATE TABLE invitation (
    token TEXT PRIMARY KEY,             -- keyed hash
    stream TEXT NOT NULL,
    participant TEXT REFERENCES participant (id)
) STRICT;

CREATE TABLE event (
    number INTEGER PRIMARY KEY,         -- order of arrival of all participants' events, 1 …
    participant TEXT NOT NULL REFERENCES participant (id),
    sequence INTEGER NOT NULL,          -- order of arrival of this participant's, 0 …
    source TEXT NOT NULL,               -- protocol, server, shown, or tab:… (a page's own events)
    source_sequence INTEGER NOT NULL,   -- order at the source; repeated deliveries are dropped
    kind TEXT NOT NULL,
    wall REAL NOT NULL,                 -- server wall clock, seconds since 1970
    monotonic REAL NOT NULL,            -- server monotonic clock, seconds; comparable within `boot`
    boot TEXT NOT NULL,
    browser REAL,                       -- the page's performance.now, milliseconds
    payload TEXT NOT NULL,              -- JSON
    state TEXT,                         -- JSON: where the participant is after it; NULL: as before
    UNIQUE (participant, sequence),
    UNIQUE (participant, source, source_sequence)
) STRICT;
CREATE INDEX event_state ON event (participant, sequence) WHERE state IS NOT NULL;
CREATE TRIGGER event_fixed BEFORE UPDATE ON event
WHEN NOT EXISTS (SELECT 1 FROM meta WHERE key = 'erasing' AND value = OLD.participant)
BEGIN SELECT RAISE(ABORT, 'events are never changed'); END;
CREATE TRIGGER event_kept BEFORE DELETE ON event
BEGIN SELECT RAISE(ABORT, 'events are never deleted'); END;

-- When somebody came, their last sign of life, and where they are.
CREATE VIEW seen AS
SELECT participant.*, first.wall AS entered, last.wall, last.monotonic, last.boot, now.state
FROM participant
JOIN event AS first ON first.participant = id AND first.sequence = 0
JOIN event AS last ON last.participant = id AND last.sequence =
    (SELECT max(sequence) FROM event WHERE event.participant = participant.id)
JOIN event AS now ON now.participant = id AND now.sequence =
    (SELECT max(sequence) FROM event
     WHERE event.participant = participant.id AND event.state IS NOT NULL);
