/* --- Serial link of the OBC's side ------------------------------------------------------------------------------- */

typedef enum {
    UNIT_NONE,        /* no message is complete */
    UNIT_TELEMETRY,   /* data of a requested row */
    UNIT_ACK,         /* a telecommand was accepted */
    UNIT_NACK,        /* a request was refused: `code`, if the unit's replies have one */
    UNIT_UNSOLICITED, /* data of a row that was not requested */
    UNIT_FAULT        /* invalid bytes were dropped */
} unit_kind_t;

typedef struct {
    unit_kind_t kind;
    uint32_t id; /* row of the message */
    uint32_t code;
    uint64_t ticks; /* counts in the header, if it has them */
    uint64_t time;
    bool is_final;        /* whether this is the last reply to the request */
    const uint8_t *data;  /* in the receiver; valid until its next call */
    size_t size;
} unit_message_t;

#define UNIT_MAX_MESSAGE @MAX_MESSAGE@u

/* For use by the functions below only. */
typedef struct {
    bool is_pending;
    bool awaits_echo;
    bool is_open;
    bool is_escaped;
    bool is_skipping;
    uint32_t pending;
    size_t size;
    size_t taken;
    uint8_t bytes[@BUFFER@u];
} unit_receiver_t;

/* Maximum size of a request with `size` bytes of data. */
#define UNIT_REQUEST_CAPACITY(size) (2u * ((size) + @OVERHEAD@u) + @MARKS@u)

/* Frame a request: a telecommand with its encoded data, or a telemetry ID without data. Return the number of bytes
 * written, 0 if `capacity` is too small or there is no such row. */
size_t unit_frame_request(uint32_t id, const uint8_t *data, size_t size, uint8_t *out, size_t capacity);

/* Data size of a telemetry row in bytes, -1 if there is no such row. */
int unit_telemetry_size(uint32_t id);

void unit_receiver_init(unit_receiver_t *receiver);

/* Record the request that is about to be sent, because a reply may not contain its ID. Only one request at a time. */
void unit_expect(unit_receiver_t *receiver, uint32_t id);

/* Take one received byte. Return the kind of the message that it completes; the message is in `message`. */
unit_kind_t unit_receive(unit_receiver_t *receiver, uint8_t byte, unit_message_t *message);

/* Discard an incomplete message. Call this after half a second of silence, and to stop waiting for a reply. Return
 * UNIT_FAULT if there was an incomplete message, otherwise UNIT_NONE. */
unit_kind_t unit_give_up(unit_receiver_t *receiver);

