-- One study, one file. Events are never changed; every other table can be computed from them
-- and the plan, which is what `python -m xplain study replay` checks.
CREATE TABLE meta (key TEXT PRIMARY KEY, value TEXT NOT NULL) STRICT;

CREATE TABLE participant (
    number INTEGER PRIMARY KEY,
    id TEXT NOT NULL UNIQUE,
    stream TEXT NOT NULL CHECK (stream IN ('person', 'pilot', 'bot')),
    entry TEXT NOT NULL,                -- invitation, prolific or open
    external TEXT UNIQUE,               -- keyed hash of the outside id, against second entries
    session TEXT,                       -- keyed hash of the outside session
    kept TEXT NOT NULL,                 -- outside ids in clear, where the config keeps them (JSON)
    entered REAL NOT NULL,              -- server wall clock, seconds
    seen REAL NOT NULL,                 -- last sign of life, server wall clock, seconds
    over INTEGER NOT NULL DEFAULT 0,
    state TEXT NOT NULL,                -- of the protocol (JSON)
    code TEXT NOT NULL                  -- completion code
) STRICT;
CREATE INDEX participant_open ON participant (over, seen);
CREATE TRIGGER once_a_bot BEFORE UPDATE OF number, id, stream, entry ON participant
BEGIN SELECT RAISE(ABORT, 'who a participant is never changes'); END;
CREATE TRIGGER participant_kept BEFORE DELETE ON participant
BEGIN SELECT RAISE(ABORT, 'participants are never deleted'); END;

CREATE TABLE invitation (
    token TEXT PRIMARY KEY,             -- keyed hash
    stream TEXT NOT NULL,
    participant TEXT REFERENCES participant (id)
) STRICT;

CREATE TABLE slot (
    stream TEXT NOT NULL,
    position INTEGER NOT NULL,          -- order of assignment
    user_type INTEGER NOT NULL,
    condition TEXT NOT NULL,
    holder TEXT REFERENCES participant (id),
    used INTEGER NOT NULL DEFAULT 0,    -- 1 once its holder has completed
    PRIMARY KEY (stream, position)
) STRICT;
CREATE INDEX slot_holder ON slot (holder);

CREATE TABLE event (
    participant TEXT NOT NULL REFERENCES participant (id),
    sequence INTEGER NOT NULL,          -- order of arrival, 0 …
    source TEXT NOT NULL,               -- protocol, server, shown, or tab:… (a page's own events)
    source_sequence INTEGER NOT NULL,   -- order at the source; repeated deliveries are dropped
    kind TEXT NOT NULL,
    wall REAL NOT NULL,                 -- server wall clock, seconds since 1970
    monotonic REAL NOT NULL,            -- server monotonic clock, seconds; comparable within `boot`
    boot TEXT NOT NULL,
    browser REAL,                       -- the page's performance.now, milliseconds
    payload TEXT NOT NULL,              -- JSON
    PRIMARY KEY (participant, sequence),
    UNIQUE (participant, source, source_sequence)
) STRICT;
CREATE TRIGGER event_fixed BEFORE UPDATE ON event
BEGIN SELECT RAISE(ABORT, 'events are never changed'); END;
CREATE TRIGGER event_kept BEFORE DELETE ON event
BEGIN SELECT RAISE(ABORT, 'events are never deleted'); END;

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
CREATE TRIGGER step_fixed BEFORE UPDATE ON step WHEN OLD.labels IS NOT NULL
BEGIN SELECT RAISE(ABORT, 'an answered step is never changed'); END;
