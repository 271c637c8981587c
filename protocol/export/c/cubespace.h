/* --- Serial link of the OBC's side ------------------------------------------------------------------------------- */

/* Format of the replies, the parameter serial_dialect of the unit: A and B for generation 1, with and without the ID in
 * the reply, C for generation 2. */
typedef enum { UNIT_DIALECT_A, UNIT_DIALECT_B, UNIT_DIALECT_C } unit_dialect_t;

typedef enum {
    UNIT_NONE,        /* no message is complete */
    UNIT_TELEMETRY,   /* data of a requested row */
    UNIT_ACK,         /* a telecommand was accepted */
    UNIT_NACK,        /* a request was refused: `code` */
    UNIT_UNSOLICITED, /* data of a row that was not requested (dialect C) */
    UNIT_EVENT,       /* dialect C */
    UNIT_BURST,       /* packet of a file: number and 20 bytes */
    UNIT_FAULT        /* invalid bytes were dropped */
} unit_kind_t;

typedef struct {
    unit_kind_t kind;
    uint8_t id;          /* row of the message */
    uint8_t code;        /* error code of a UNIT_NACK */
    const uint8_t *data; /* in the receiver; valid until its next call */
    size_t size;
} unit_message_t;

#define UNIT_MAX_MESSAGE 512u

/* For use by the functions below only. */
typedef struct {
    unit_dialect_t dialect;
    uint8_t state;
    uint8_t start;
    bool in_junk;
    bool is_pending;
    uint8_t pending;
    size_t size;
    uint8_t body[UNIT_MAX_MESSAGE];
} unit_receiver_t;

/* Maximum size of a request with `size` bytes of data. */
#define UNIT_REQUEST_CAPACITY(size) (2u * (size) + 6u)

/* Frame a request: a telecommand with its encoded data, or a telemetry ID without data. Return the number of bytes
 * written, 0 if `capacity` is too small. */
size_t unit_frame_request(uint8_t id, const uint8_t *data, size_t size, uint8_t *out, size_t capacity);

/* Data size of a telemetry row in bytes, -1 if there is no such row. */
int unit_telemetry_size(uint8_t id);

void unit_receiver_init(unit_receiver_t *receiver, unit_dialect_t dialect);

/* Record the request that is about to be sent: replies in dialect B, and refusals in dialect A, do not contain the ID.
 * Only one request at a time. */
void unit_expect(unit_receiver_t *receiver, uint8_t id);

/* Take one received byte. Return the kind of the message that it completes; the message is in `message`. */
unit_kind_t unit_receive(unit_receiver_t *receiver, uint8_t byte, unit_message_t *message);

/* Discard an incomplete message. Call this after half a second of silence, and to stop waiting for a reply. Return
 * UNIT_FAULT if there was an incomplete message, otherwise UNIT_NONE. */
unit_kind_t unit_give_up(unit_receiver_t *receiver);

