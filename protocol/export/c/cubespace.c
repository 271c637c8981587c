/* --- Serial link of the OBC's side ------------------------------------------------------------------------------- */

enum { ESCAPE = 0x1F, END = 0xFF, START = 0x7F };
enum { START_ACK = 0x07, START_NACK = 0x0F, START_EVENT = 0x2F, START_UNSOLICITED = 0x4F };
enum { FIRST_TELEMETRY = 128, BURST_ID = 119, BURST_SIZE = 22 };
enum { IDLE, IDLE_ESCAPED, FIRST, FIRST_ESCAPED, BODY, BODY_ESCAPED };

size_t unit_frame_request(uint8_t id, const uint8_t *data, size_t size, uint8_t *out, size_t capacity)
{
    size_t length = 0u;
    size_t i;
    if (capacity < 2u) {
        return 0u;
    }
    out[length] = ESCAPE;
    ++length;
    out[length] = START;
    ++length;
    for (i = 0u; i <= size; ++i) {
        const uint8_t byte = i == 0u ? id : data[i - 1u];
        if (capacity - length < (byte == ESCAPE ? 4u : 3u)) {
            return 0u;
        }
        out[length] = byte;
        ++length;
        if (byte == ESCAPE) {
            out[length] = ESCAPE;
            ++length;
        }
    }
    out[length] = ESCAPE;
    ++length;
    out[length] = END;
    ++length;
    return length;
}

void unit_receiver_init(unit_receiver_t *receiver, unit_dialect_t dialect)
{
    (void)memset(receiver, 0, sizeof *receiver);
    receiver->dialect = dialect;
    receiver->state = IDLE;
}

void unit_expect(unit_receiver_t *receiver, uint8_t id)
{
    receiver->is_pending = true;
    receiver->pending = id;
}

unit_kind_t unit_give_up(unit_receiver_t *receiver)
{
    const bool open = receiver->state != IDLE && !(receiver->state == IDLE_ESCAPED && receiver->in_junk);
    receiver->state = IDLE;
    receiver->in_junk = false;
    receiver->is_pending = false;
    return open ? UNIT_FAULT : UNIT_NONE;
}

static bool is_start(const unit_receiver_t *receiver, uint8_t byte)
{
    return byte == START
           || (receiver->dialect == UNIT_DIALECT_C
               && (byte == START_ACK || byte == START_NACK || byte == START_EVENT || byte == START_UNSOLICITED));
}

static void begin(unit_receiver_t *receiver, uint8_t start)
{
    receiver->state = FIRST;
    receiver->start = start;
    receiver->size = 0u;
    receiver->in_junk = false;
}

/* A run of bytes outside messages is one fault. */
static unit_kind_t junk(unit_receiver_t *receiver)
{
    const unit_kind_t kind = receiver->in_junk ? UNIT_NONE : UNIT_FAULT;
    receiver->in_junk = true;
    return kind;
}

static unit_kind_t abandon(unit_receiver_t *receiver)
{
    receiver->state = IDLE;
    receiver->in_junk = true;
    return UNIT_FAULT;
}

static unit_kind_t add(unit_receiver_t *receiver, uint8_t byte)
{
    receiver->state = BODY;
    if (receiver->size >= UNIT_MAX_MESSAGE) {
        return abandon(receiver);
    }
    receiver->body[receiver->size] = byte;
    ++receiver->size;
    return UNIT_NONE;
}

/* The single data byte is an error code. */
static unit_kind_t with_code(unit_message_t *message, unit_kind_t kind)
{
    message->code = message->data[0];
    message->size = 0u;
    return kind;
}

static unit_kind_t generation_2(const unit_receiver_t *receiver, unit_message_t *message)
{
    switch (receiver->start) {
    case START_ACK:
        return message->id >= FIRST_TELEMETRY ? UNIT_TELEMETRY : UNIT_ACK;
    case START_NACK:
        return message->size == 1u && message->data[0] != 0u ? with_code(message, UNIT_NACK) : UNIT_FAULT;
    case START_EVENT:
        return UNIT_EVENT;
    case START_UNSOLICITED:
        return UNIT_UNSOLICITED;
    default:
        return message->id == BURST_ID && message->size == BURST_SIZE ? UNIT_BURST : UNIT_FAULT;
    }
}

static unit_kind_t generation_1(unit_receiver_t *receiver, unit_message_t *message)
{
    const bool expected = receiver->is_pending && receiver->pending == message->id;
    if (message->id >= FIRST_TELEMETRY) {
        const bool is_code = expected && message->size == 1u && unit_telemetry_size(message->id) != 1;
        if (is_code && message->data[0] == 0u) {
            return UNIT_FAULT; /* an acknowledge that comes late: no refusal has the code 0 */
        }
        receiver->is_pending = receiver->is_pending && !expected;
        return is_code ? with_code(message, UNIT_NACK) : UNIT_TELEMETRY;
    }
    if (message->size != 1u) {
        return UNIT_FAULT;
    }
    receiver->is_pending = receiver->is_pending && !expected;
    return with_code(message, message->data[0] == 0u ? UNIT_ACK : UNIT_NACK);
}

static bool is_burst(const unit_receiver_t *receiver)
{
    if (receiver->size != BURST_SIZE + 1 || receiver->body[0] != BURST_ID) {
        return false;
    }
    return receiver->dialect == UNIT_DIALECT_A || !receiver->is_pending
           || unit_telemetry_size(receiver->pending) != (int)receiver->size;
}

static unit_kind_t interpret(unit_receiver_t *receiver, unit_message_t *message)
{
    message->id = receiver->body[0];
    message->data = &receiver->body[1];
    message->size = receiver->size - 1u;
    if (receiver->dialect == UNIT_DIALECT_C) {
        return generation_2(receiver, message);
    }
    if (is_burst(receiver)) {
        return UNIT_BURST;
    }
    if (receiver->dialect == UNIT_DIALECT_B) {
        if (!receiver->is_pending) {
            return UNIT_FAULT;
        }
        message->id = receiver->pending;
        message->data = receiver->body;
        message->size = receiver->size;
    }
    return generation_1(receiver, message);
}

static unit_kind_t after_escape(unit_receiver_t *receiver, uint8_t byte, unit_message_t *message)
{
    if (byte == ESCAPE) {
        return add(receiver, ESCAPE);
    }
    if (byte == END) {
        receiver->state = IDLE;
        receiver->in_junk = false;
        return receiver->size > 0u ? interpret(receiver, message) : UNIT_FAULT;
    }
    if (is_start(receiver, byte)) {
        begin(receiver, byte);
        return UNIT_FAULT;
    }
    return abandon(receiver);
}

static unit_kind_t advance(unit_receiver_t *receiver, uint8_t byte, unit_message_t *message)
{
    switch (receiver->state) {
    case IDLE:
        if (byte == ESCAPE) {
            receiver->state = IDLE_ESCAPED;
            return UNIT_NONE;
        }
        return junk(receiver);
    case IDLE_ESCAPED:
        if (is_start(receiver, byte)) {
            begin(receiver, byte);
            return UNIT_NONE;
        }
        if (byte != ESCAPE) {
            receiver->state = IDLE;
        }
        return junk(receiver);
    case FIRST:
        if (byte == ESCAPE) {
            receiver->state = receiver->dialect == UNIT_DIALECT_B ? BODY_ESCAPED : FIRST_ESCAPED;
            return UNIT_NONE;
        }
        return add(receiver, byte);
    case FIRST_ESCAPED: /* an ID of 1F: some senders double it, others do not */
        if (byte == ESCAPE || byte == END || is_start(receiver, byte)) {
            return after_escape(receiver, byte, message);
        }
        (void)add(receiver, ESCAPE);
        return add(receiver, byte);
    case BODY:
        if (byte == ESCAPE) {
            receiver->state = BODY_ESCAPED;
            return UNIT_NONE;
        }
        return add(receiver, byte);
    default:
        return after_escape(receiver, byte, message);
    }
}

unit_kind_t unit_receive(unit_receiver_t *receiver, uint8_t byte, unit_message_t *message)
{
    (void)memset(message, 0, sizeof *message);
    message->kind = advance(receiver, byte, message);
    return message->kind;
}
