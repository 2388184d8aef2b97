-- One study or collection, one file. Events are never changed; every other table can be computed
-- from them and the plan, which is what the command `replay` checks. The triggers hold for REPLACE
-- too (PRAGMA recursive_triggers); only the erasure of a participant passes them.
CREATE TABLE meta (key TEXT PRIMARY KEY, value TEXT NOT NULL) STRICT;
CREATE TRIGGER meta_fixed BEFORE UPDATE ON meta WHEN OLD.key != 'head' OR NEW.key != 'head'
BEGIN SELECT RAISE(ABORT, 'the plan is never changed'); END;
CREATE TRIGGER meta_kept BEFORE DELETE ON meta WHEN OLD.key != 'erasing'
BEGIN SELECT RAISE(ABORT, 'the plan is never deleted'); END;

-- What the researcher switches on and off.
CREATE TABLE control (key TEXT PRIMARY KEY, value TEXT NOT NULL) STRICT;

CREATE TABLE participant (
    number INTEGER PRIMARY KEY,
    id TEXT NOT NULL UNIQUE,            -- random; in every table of an export
    stream TEXT NOT NULL CHECK (stream IN ('person', 'pilot', 'bot')),
    entry TEXT NOT NULL,                -- invitation, platform, open or preview
    external TEXT UNIQUE,               -- keyed hash of the outside id, against second entries
    session TEXT,                       -- keyed hash of the outside session
    kept TEXT NOT NULL,                 -- outside ids in clear, where the config keeps them (JSON)
    over INTEGER NOT NULL DEFAULT 0,
    state TEXT NOT NULL,                -- of the protocol (JSON)
    code TEXT NOT NULL,                 -- completion code
    salt TEXT NOT NULL,                 -- of the hashes of their events; gone once erased
    erased INTEGER NOT NULL DEFAULT 0
) STRICT;
CREATE INDEX participant_open ON participant (over);
CREATE TRIGGER once_a_bot
BEFORE UPDATE OF number, id, stream, entry, external, session, kept, code, salt, erased
ON participant WHEN NOT EXISTS (SELECT 1 FROM meta WHERE key = 'erasing' AND value = OLD.id)
BEGIN SELECT RAISE(ABORT, 'who a participant is never changes'); END;
CREATE TRIGGER participant_kept BEFORE DELETE ON participant
BEGIN SELECT RAISE(ABORT, 'participants are never deleted'); END;

CREATE TABLE invitation (
    token TEXT PRIMARY KEY,             -- keyed hash
    stream TEXT NOT NULL,
    participant TEXT REFERENCES participant (id)
) STRICT;
CREATE TRIGGER invitation_fixed BEFORE UPDATE ON invitation
WHEN OLD.participant IS NOT NULL OR NEW.token != OLD.token OR NEW.stream != OLD.stream
BEGIN SELECT RAISE(ABORT, 'a used invitation is never changed'); END;
CREATE TRIGGER invitation_kept BEFORE DELETE ON invitation
BEGIN SELECT RAISE(ABORT, 'invitations are never deleted'); END;

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
    content TEXT NOT NULL,              -- hash of this event (xplain/people/analysis/log.py)
    digest TEXT NOT NULL,               -- hash of this event and all before it
    UNIQUE (participant, sequence),
    UNIQUE (participant, source, source_sequence)
) STRICT;
CREATE TRIGGER event_fixed BEFORE UPDATE ON event
WHEN (NEW.number, NEW.participant, NEW.sequence, NEW.content, NEW.digest)
     IS NOT (OLD.number, OLD.participant, OLD.sequence, OLD.content, OLD.digest)
     OR NOT EXISTS (SELECT 1 FROM meta WHERE key = 'erasing' AND value = OLD.participant)
BEGIN SELECT RAISE(ABORT, 'events are never changed'); END;
CREATE TRIGGER event_kept BEFORE DELETE ON event
BEGIN SELECT RAISE(ABORT, 'events are never deleted'); END;

-- When somebody came, and their last sign of life.
CREATE VIEW seen AS
SELECT participant.*, first.wall AS entered, last.wall, last.monotonic, last.boot FROM participant
JOIN event AS first ON first.participant = id AND first.sequence = 0
JOIN event AS last ON last.participant = id AND last.sequence =
    (SELECT max(sequence) FROM event WHERE event.participant = participant.id);

CREATE TABLE step (
    participant TEXT NOT NULL REFERENCES participant (id),
    k INTEGER NOT NULL,
    belief_before TEXT NOT NULL,        -- JSON [N]
    given INTEGER NOT NULL,             -- bitmask before the step
    messages INTEGER NOT NULL,          -- bitmask of the new ones
    action_values TEXT NOT NULL,        -- JSON {bitmask: value}
    labels TEXT,                        -- JSON [k + 1], once given
    belief_after TEXT,                  -- JSON [N]
    PRIMARY KEY (participant, k)
) STRICT;
CREATE TRIGGER step_fixed BEFORE UPDATE ON step
WHEN OLD.labels IS NOT NULL
     OR (NEW.participant, NEW.k, NEW.belief_before, NEW.given, NEW.messages, NEW.action_values)
     IS NOT (OLD.participant, OLD.k, OLD.belief_before, OLD.given, OLD.messages, OLD.action_values)
BEGIN SELECT RAISE(ABORT, 'an answered step is never changed'); END;
CREATE TRIGGER step_kept BEFORE DELETE ON step
WHEN NOT EXISTS (SELECT 1 FROM meta WHERE key = 'erasing' AND value = OLD.participant)
BEGIN SELECT RAISE(ABORT, 'steps are never deleted'); END;
