/* --- Serial link of the OBC's side ------------------------------------------------------------------------------- */

typedef enum {
    UNIT_NONE,        /* nothing is complete yet */
    UNIT_TELEMETRY,   /* data of a row that was asked for */
    UNIT_ACK,         /* a telecommand was accepted */
    UNIT_NACK,        /* a request was refused: `code`, where the unit's replies have one */
    UNIT_UNSOLICITED, /* data of a row that was not asked for */
    UNIT_FAULT        /* bytes that are no message were dropped */
} unit_kind_t;

typedef struct {
    unit_kind_t kind;
    uint32_t id; /* row that it is about */
    uint32_t code;
    uint64_t ticks, time; /* of the header, in its counts, where it has them */
    bool is_final;        /* no further reply to the same request follows */
    const uint8_t *data;  /* in the receiver; valid until its next call */
    size_t size;
} unit_message_t;

#define UNIT_MAX_MESSAGE @MAX_MESSAGE@u

/* For use by the functions below only. */
typedef struct {
    bool is_pending, awaits_echo, is_open, is_escaped, is_skipping;
    uint32_t pending;
    size_t size, taken;
    uint8_t bytes[@BUFFER@u];
} unit_receiver_t;

/* Bytes that a request with `size` bytes of data takes at most. */
#define UNIT_REQUEST_CAPACITY(size) (2u * ((size) + @OVERHEAD@u) + @MARKS@u)

/* Frame a request: a telecommand with its encoded data, or the identifier of telemetry without data. Return the number
 * of bytes written, 0 if `capacity` is too small or there is no such row. */
size_t unit_frame_request(uint32_t id, const uint8_t *data, size_t size, uint8_t *out, size_t capacity);

/* Bytes of data of a telemetry row, -1 if there is no such row. */
int unit_telemetry_size(uint32_t id);

void unit_receiver_init(unit_receiver_t *receiver);

/* Note the request that is about to be sent, since a reply may name no row. One request may be open at a time. */
void unit_expect(unit_receiver_t *receiver, uint32_t id);

/* Take one received byte. Return the kind of the message that it completes, with the rest of it in `message`. */
unit_kind_t unit_receive(unit_receiver_t *receiver, uint8_t byte, unit_message_t *message);

/* Abandon a message that has begun and not ended; call it after half a second of silence, and when a reply is given
 * up. Return UNIT_FAULT if there was one, else UNIT_NONE. */
unit_kind_t unit_give_up(unit_receiver_t *receiver);

