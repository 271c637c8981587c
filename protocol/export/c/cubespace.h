/* --- Serial link of the OBC's side ------------------------------------------------------------------------------- */

/* Form of the replies, the parameter serial_dialect of the unit: A and B of generation 1, with the identifier in the
 * reply and without it, C of generation 2. */
typedef enum { UNIT_DIALECT_A, UNIT_DIALECT_B, UNIT_DIALECT_C } unit_dialect_t;

typedef enum {
    UNIT_NONE,        /* nothing is complete yet */
    UNIT_TELEMETRY,   /* data of a row that was asked for */
    UNIT_ACK,         /* a telecommand was accepted */
    UNIT_NACK,        /* a request was refused: `code` */
    UNIT_UNSOLICITED, /* data of a row that was not asked for (dialect C) */
    UNIT_EVENT,       /* dialect C */
    UNIT_BURST,       /* packet of a file: number and 20 bytes */
    UNIT_FAULT        /* bytes that are no message were dropped */
} unit_kind_t;

typedef struct {
    unit_kind_t kind;
    uint8_t id;          /* row that it is about */
    uint8_t code;        /* error code of a UNIT_NACK */
    const uint8_t *data; /* in the receiver; valid until its next call */
    size_t size;
} unit_message_t;

#define UNIT_MAX_MESSAGE 512u

/* For use by the functions below only. */
typedef struct {
    unit_dialect_t dialect;
    uint8_t state, start;
    bool in_junk, is_pending;
    uint8_t pending;
    size_t size;
    uint8_t body[UNIT_MAX_MESSAGE];
} unit_receiver_t;

/* Bytes that a request with `size` bytes of data takes at most. */
#define UNIT_REQUEST_CAPACITY(size) (2u * (size) + 6u)

/* Frame a request: a telecommand with its encoded data, or the identifier of telemetry without data. Return the number
 * of bytes written, 0 if `capacity` is too small. */
size_t unit_frame_request(uint8_t id, const uint8_t *data, size_t size, uint8_t *out, size_t capacity);

/* Bytes of data of a telemetry row, -1 if there is no such row. */
int unit_telemetry_size(uint8_t id);

void unit_receiver_init(unit_receiver_t *receiver, unit_dialect_t dialect);

/* Note the request that is about to be sent: replies of dialect B, and refusals of dialect A, name no row. One request
 * may be open at a time. */
void unit_expect(unit_receiver_t *receiver, uint8_t id);

/* Take one received byte. Return the kind of the message that it completes, with the rest of it in `message`. */
unit_kind_t unit_receive(unit_receiver_t *receiver, uint8_t byte, unit_message_t *message);

/* Abandon a message that has begun and not ended; call it after half a second of silence, and when a reply is given
 * up. Return UNIT_FAULT if there was one, else UNIT_NONE. */
unit_kind_t unit_give_up(unit_receiver_t *receiver);

