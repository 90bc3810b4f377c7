"""Every period and cap of recordings: what a writer keeps to, and what a reader refuses."""

# Writer (`writer`): bytes of a chunk; and with the recorder's own delay, kill -9 loses half a second.
RECORDING_CHUNK_BYTES = 64 << 10
CHUNK_FLUSH_S = 0.4
# From a write that failed to the next attempt, in a new segment.
WRITE_RETRY_S = 10.0
# That `max_bytes` is divided into: the oldest goes as a whole.
LEAST_SEGMENTS = 4

# Records (`records`): a length beyond it is no length but garbage.
LARGEST_RECORD_BYTES = 32 << 20
# Unpacked: ours hold 64 KiB, or one large message.
LARGEST_CHUNK_BYTES = 64 << 20
# Of a schema, a channel or metadata; and of an attachment.
LARGEST_NOTE_BYTES, LARGEST_ATTACHMENT_BYTES = 1 << 20, 8 << 20
# Characters.
LONGEST_RECORD_NAME = 256

# Reader (`reader`): bytes of a file, which is read from one end to the other.
READ_AHEAD_BYTES = 1 << 20
# Of one file, schemas and channels, the same one again included: our largest swarms declare some hundreds.
MOST_DECLARED_CHANNELS = 20_000
# Metadata and attachments; and bytes of all of them.
MOST_NOTES, LARGEST_NOTES_BYTES = 64, 32 << 20
# Messages, of which a rate is told (`info`).
RATE_LEAST_MESSAGES = 5
