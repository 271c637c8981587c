// slip
static void put_start(output_t *output)
{
    if (LEADING_END) {
        put_raw(output, END_BYTE);
    }
}

static void put_body(output_t *output, const uint8_t *bytes, size_t size)
{
    size_t i;
    for (i = 0u; i < size; ++i) {
        if (bytes[i] == END_BYTE || bytes[i] == ESCAPE) {
            put_raw(output, ESCAPE);
            put_raw(output, bytes[i] == END_BYTE ? ESCAPED_END : ESCAPED_ESCAPE);
        } else {
            put_raw(output, bytes[i]);
        }
    }
}

static void put_end(output_t *output)
{
    put_raw(output, END_BYTE);
}

static unit_kind_t advance(unit_receiver_t *receiver, uint8_t byte, unit_message_t *message)
{
    const size_t size = receiver->size;
    if (byte == END_BYTE) {
        const bool is_bad = receiver->is_escaped && !receiver->is_skipping;
        const bool is_message = size > 0u && !receiver->is_escaped && !receiver->is_skipping;
        receiver->is_escaped = false;
        receiver->is_skipping = false;
        receiver->taken = size;
        if (is_bad) {
            return UNIT_FAULT;
        }
        return is_message ? interpret(receiver, receiver->bytes, size, message) : UNIT_NONE;
    }
    if (receiver->is_skipping) {
        return UNIT_NONE;
    }
    if (byte == ESCAPE && !receiver->is_escaped) {
        receiver->is_escaped = true;
        return UNIT_NONE;
    }
    if (size >= UNIT_MAX_MESSAGE || (receiver->is_escaped && byte != ESCAPED_END && byte != ESCAPED_ESCAPE)) {
        receiver->is_skipping = true;
        receiver->is_escaped = false;
        receiver->taken = size;
        return UNIT_FAULT;
    }
    if (receiver->is_escaped) {
        receiver->is_escaped = false;
        byte = byte == ESCAPED_END ? END_BYTE : ESCAPE;
    }
    receiver->bytes[receiver->size] = byte;
    ++receiver->size;
    return UNIT_NONE;
}

// escaped
static void put_start(output_t *output)
{
    put_raw(output, ESCAPE);
    put_raw(output, START_BYTE);
}

static void put_body(output_t *output, const uint8_t *bytes, size_t size)
{
    size_t i;
    for (i = 0u; i < size; ++i) {
        put_raw(output, bytes[i]);
        if (bytes[i] == ESCAPE) {
            put_raw(output, ESCAPE);
        }
    }
}

static void put_end(output_t *output)
{
    put_raw(output, ESCAPE);
    put_raw(output, END_BYTE);
}

static unit_kind_t advance(unit_receiver_t *receiver, uint8_t byte, unit_message_t *message)
{
    const size_t size = receiver->size;
    const bool was_open = receiver->is_open;
    if (byte == ESCAPE && !receiver->is_escaped) {
        receiver->is_escaped = true;
        return UNIT_NONE;
    }
    if (receiver->is_escaped && byte != ESCAPE) {
        receiver->is_escaped = false;
        receiver->taken = size;
        receiver->is_open = byte == START_BYTE;
        if (was_open && byte == END_BYTE && size > 0u) {
            return interpret(receiver, receiver->bytes, size, message);
        }
        return was_open ? UNIT_FAULT : UNIT_NONE;
    }
    receiver->is_escaped = false;
    if (!was_open) {
        return UNIT_NONE;
    }
    if (size >= UNIT_MAX_MESSAGE) {
        receiver->is_open = false;
        receiver->taken = size;
        return UNIT_FAULT;
    }
    receiver->bytes[receiver->size] = byte;
    ++receiver->size;
    return UNIT_NONE;
}

// counted
static void put_start(output_t *output)
{
    put_plain(output, start_bytes, START_SIZE);
}

static void put_body(output_t *output, const uint8_t *bytes, size_t size)
{
    put_plain(output, bytes, size);
}

static void put_end(output_t *output)
{
    put_plain(output, end_bytes, END_SIZE);
}

/* Size of the body that begins with these bytes: 0 if more are needed, -1 if they are invalid. */
static long measure(const unit_receiver_t *receiver, const uint8_t *body, size_t size)
{
    head_t head;
    if (receiver->awaits_echo) {
        return (long)request_body_size(receiver->pending);
    }
    switch (unpack_header(receiver, body, size, &head)) {
    case HEAD_SHORT:
        return 0;
    case HEAD_WHOLE:
        return head.data_size < 0 ? -1 : (long)head.size + (long)CHECK_SIZE + head.data_size;
    default:
        return -1;
    }
}

/* Examine the bytes from `start` on; true if the search has to continue at the next byte. */
static bool look(unit_receiver_t *receiver, size_t start, unit_kind_t *kind, unit_message_t *message)
{
    const uint8_t *bytes = &receiver->bytes[start];
    const size_t size = receiver->size - start;
    const size_t known = size < START_SIZE ? size : START_SIZE;
    long body;
    size_t whole;
    if (memcmp(bytes, start_bytes, known) != 0) {
        return true;
    }
    if (size < START_SIZE) {
        return false;
    }
    body = measure(receiver, &bytes[START_SIZE], size - START_SIZE);
    if (body == 0) {
        return false;
    }
    if (body < 0 || body > (long)UNIT_MAX_MESSAGE) {
        *kind = UNIT_FAULT;
        return true;
    }
    whole = START_SIZE + (size_t)body + END_SIZE;
    if (size < whole) {
        return false;
    }
    if (memcmp(&bytes[whole - END_SIZE], end_bytes, END_SIZE) != 0) {
        *kind = UNIT_FAULT;
        return true;
    }
    *kind = interpret(receiver, &bytes[START_SIZE], (size_t)body, message);
    if (*kind == UNIT_FAULT) {
        return true;
    }
    receiver->taken = start + whole;
    return false;
}

static unit_kind_t advance(unit_receiver_t *receiver, uint8_t byte, unit_message_t *message)
{
    unit_kind_t kind = UNIT_NONE;
    size_t start = 0u;
    receiver->bytes[receiver->size] = byte;
    ++receiver->size;
    while (start < receiver->size && look(receiver, start, &kind, message)) {
        ++start;
    }
    if (receiver->taken == 0u) {
        receiver->taken = start;
    }
    return kind;
}

// delimited
static void put_start(output_t *output)
{
    put_plain(output, start_bytes, START_SIZE);
}

static void put_body(output_t *output, const uint8_t *bytes, size_t size)
{
    static const char digits[] = "0123456789ABCDEF";
    size_t i;
    for (i = 0u; i < size; ++i) {
        if (IS_HEX) {
            put_raw(output, (uint8_t)digits[bytes[i] >> 4]);
            put_raw(output, (uint8_t)digits[bytes[i] & 0x0Fu]);
        } else {
            put_raw(output, bytes[i]);
        }
    }
}

static void put_end(output_t *output)
{
    put_plain(output, end_bytes, END_SIZE);
}

static int digit(uint8_t text)
{
    if (text >= '0' && text <= '9') {
        return text - '0';
    }
    text = (uint8_t)(text | 0x20u);
    return text >= 'a' && text <= 'f' ? text - 'a' + 10 : -1;
}

/* Decode hexadecimal digits in place. Return the number of bytes, -1 if they are invalid. */
static long from_hex(uint8_t *text, size_t size)
{
    size_t i;
    if (!IS_HEX) {
        return (long)size;
    }
    for (i = 0u; i + 1u < size; i += 2u) {
        const int high = digit(text[i]);
        const int low = digit(text[i + 1u]);
        if (high < 0 || low < 0) {
            return -1;
        }
        text[i / 2u] = (uint8_t)(high << 4 | low);
    }
    return size % 2u != 0u ? -1 : (long)(size / 2u);
}

static unit_kind_t advance(unit_receiver_t *receiver, uint8_t byte, unit_message_t *message)
{
    size_t start = 0u;
    size_t size;
    size_t i;
    long body;
    if (receiver->size >= sizeof receiver->bytes) {
        --receiver->size;
        (void)memmove(receiver->bytes, &receiver->bytes[1], receiver->size);
        receiver->is_skipping = true;
    }
    receiver->bytes[receiver->size] = byte;
    ++receiver->size;
    size = receiver->size;
    if (size < END_SIZE || memcmp(&receiver->bytes[size - END_SIZE], end_bytes, END_SIZE) != 0) {
        return UNIT_NONE;
    }
    size -= END_SIZE;
    receiver->taken = receiver->size;
    if (receiver->is_skipping) {
        receiver->is_skipping = false;
        return UNIT_FAULT;
    }
    if (START_SIZE != 0u) {
        for (i = 0u; i + START_SIZE <= size; ++i) {
            if (memcmp(&receiver->bytes[i], start_bytes, START_SIZE) == 0) {
                start = i + START_SIZE;
            }
        }
        if (start == 0u) {
            return UNIT_FAULT;
        }
    }
    body = from_hex(&receiver->bytes[start], size - start);
    return body < 0 ? UNIT_FAULT : interpret(receiver, &receiver->bytes[start], (size_t)body, message);
}
