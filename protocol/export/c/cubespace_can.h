/* --- CAN of the OBC's side ------------------------------------------------------------------------------------------ */

typedef struct {
    uint32_t id; /* 29 bits; neither a standard nor a remote frame */
    uint8_t size;
    uint8_t data[8];
} unit_can_frame_t;

/* For use by the functions below only. */
typedef struct {
    bool is_open;
    bool is_broken;
    uint8_t row;
    uint8_t first;
    uint8_t left;
    size_t size;
    uint8_t body[UNIT_MAX_MESSAGE];
} unit_can_message_t;

typedef struct {
    uint8_t address;
    uint8_t device;
    uint8_t single[8];
    unit_can_message_t telemetry;
    unit_can_message_t burst;
    unit_can_message_t unsolicited;
} unit_can_receiver_t;

/* Number of frames of a request with `size` bytes of data. */
#define UNIT_CAN_FRAMES(size) ((size) <= 8u ? 1u : ((size) + 6u) / 7u)

/* Make frame `number`, from 0, of a request from the OBC's address to the unit's: a telecommand with its
 * encoded data, or a telemetry ID without data. Return false if the request has no such frame. */
bool unit_can_request(uint8_t id, const uint8_t *data, size_t size, uint8_t address, uint8_t device, size_t number,
                      unit_can_frame_t *frame);

/* Initialise a receiver for messages from the unit at `device` to the OBC at `address`. */
void unit_can_receiver_init(unit_can_receiver_t *receiver, uint8_t address, uint8_t device);

/* Take one received frame. Return the kind of the message that it completes; the message is in `message`. */
unit_kind_t unit_can_receive(unit_can_receiver_t *receiver, const unit_can_frame_t *frame, unit_message_t *message);

/* Discard incomplete messages; call this after half a second of silence. Return UNIT_FAULT if there was one. */
unit_kind_t unit_can_give_up(unit_can_receiver_t *receiver);
