/* --- CAN of the OBC's side ------------------------------------------------------------------------------------------ */

enum { CAN_TELECOMMAND = 1, CAN_ACK, CAN_NACK, CAN_REQUEST, CAN_TELEMETRY, CAN_TELEMETRY_NACK, CAN_LONG_TELECOMMAND };
enum { CAN_LONG_TELEMETRY = 8, CAN_EVENT, CAN_FIRST, CAN_BODY, CAN_LAST };
enum { SEGMENT = 7, MAX_SEGMENTS = 256 };

bool unit_can_request(uint8_t id, const uint8_t *data, size_t size, uint8_t address, uint8_t device, size_t number,
                      unit_can_frame_t *frame)
{
    const size_t frames = UNIT_CAN_FRAMES(size);
    const size_t start = SEGMENT * number;
    const uint32_t command = frames > 1u ? CAN_LONG_TELECOMMAND : CAN_TELECOMMAND;
    const uint32_t type = id >= FIRST_TELEMETRY ? (uint32_t)CAN_REQUEST : command;
    (void)memset(frame, 0, sizeof *frame);
    if (number >= frames || frames > MAX_SEGMENTS) {
        return false;
    }
    frame->id = type << 24 | (uint32_t)id << 16 | (uint32_t)address << 8 | device;
    frame->size = (uint8_t)(frames > 1u && size - start > SEGMENT ? SEGMENT : size - start);
    if (frame->size > 0u) {
        (void)memcpy(frame->data, &data[start], frame->size);
    }
    if (frames > 1u) {
        frame->data[frame->size] = (uint8_t)(frames - 1u - number);
        ++frame->size;
    }
    return true;
}

void unit_can_receiver_init(unit_can_receiver_t *receiver, uint8_t address, uint8_t device)
{
    (void)memset(receiver, 0, sizeof *receiver);
    receiver->address = address;
    receiver->device = device;
}

unit_kind_t unit_can_give_up(unit_can_receiver_t *receiver)
{
    const bool open = receiver->telemetry.is_open || receiver->burst.is_open || receiver->unsolicited.is_open;
    receiver->telemetry.is_open = false;
    receiver->burst.is_open = false;
    receiver->unsolicited.is_open = false;
    return open ? UNIT_FAULT : UNIT_NONE;
}

/* A segment out of order breaks its message: further segments are skipped up to the end or a new start. */
static unit_kind_t can_add(unit_can_message_t *open, bool starts, const unit_can_frame_t *frame, unit_kind_t whole,
                           unit_message_t *message)
{
    const size_t size = frame->size > 0u ? frame->size - 1u : 0u;
    const uint8_t left = frame->data[size];
    const bool may_start = size == SEGMENT && left > 0u;
    const bool cut = open->is_open && (starts || open->row != message->id);
    unit_kind_t kind = cut ? UNIT_FAULT : UNIT_NONE;
    open->is_open = open->is_open && !cut && frame->size > 0u;
    if (!open->is_open || open->is_broken || left + 1u != open->left || (left > 0u && !may_start)) {
        kind = (open->is_open ? !open->is_broken : !may_start || cut) ? UNIT_FAULT : UNIT_NONE;
        open->is_broken = !may_start || (open->is_open && left < open->first);
        if (open->is_broken) {
            open->is_open = open->is_open && left > 0u;
            return kind;
        }
        open->row = message->id;
        open->first = left;
        open->size = 0u;
    }
    open->is_open = left > 0u;
    open->left = left;
    open->is_broken = open->size + size + left > UNIT_MAX_MESSAGE;
    if (open->is_broken) {
        return UNIT_FAULT;
    }
    (void)memcpy(&open->body[open->size], frame->data, size);
    open->size += size;
    message->data = open->body;
    message->size = open->size;
    return left > 0u ? kind : whole;
}

static unit_kind_t can_interpret(unit_can_receiver_t *receiver, const unit_can_frame_t *frame, unit_message_t *message)
{
    const uint32_t type = frame->id >> 24 & 0x1Fu;
    const bool burst = message->id == BURST_ID;
    unit_can_message_t *open = &receiver->unsolicited;
    switch (type) {
    case CAN_TELECOMMAND:
    case CAN_REQUEST:
    case CAN_LONG_TELECOMMAND:
        return UNIT_NONE;
    case CAN_ACK:
        return UNIT_ACK;
    case CAN_TELEMETRY:
        return UNIT_TELEMETRY;
    case CAN_EVENT:
        return UNIT_EVENT;
    case CAN_NACK:
    case CAN_TELEMETRY_NACK:
        return message->size > 0u ? with_code(message, UNIT_NACK) : UNIT_FAULT;
    case CAN_LONG_TELEMETRY:
        open = burst ? &receiver->burst : &receiver->telemetry;
        return can_add(open, false, frame, burst ? UNIT_BURST : UNIT_TELEMETRY, message);
    case CAN_LAST: /* a single frame with a short message */
        if (!open->is_open || open->row != message->id) {
            return UNIT_UNSOLICITED;
        }
        return can_add(open, false, frame, UNIT_UNSOLICITED, message);
    default:
        return type == CAN_FIRST || type == CAN_BODY
                   ? can_add(open, type == CAN_FIRST, frame, UNIT_UNSOLICITED, message)
                   : UNIT_FAULT;
    }
}

unit_kind_t unit_can_receive(unit_can_receiver_t *receiver, const unit_can_frame_t *frame, unit_message_t *message)
{
    (void)memset(message, 0, sizeof *message);
    if ((frame->id & 0xFFu) == receiver->address && (frame->id >> 8 & 0xFFu) == receiver->device && frame->size <= 8u) {
        (void)memcpy(receiver->single, frame->data, sizeof receiver->single);
        message->id = (uint8_t)(frame->id >> 16);
        message->data = receiver->single;
        message->size = frame->size;
        message->kind = can_interpret(receiver, frame, message);
    }
    return message->kind;
}
