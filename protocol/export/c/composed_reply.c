/* The echo of the request: its header again. */
static unit_kind_t interpret_echo(unit_receiver_t *receiver, const uint8_t *body, size_t size,
                                  unit_message_t *message)
{
    uint8_t head[@HEADER@];
    const size_t header = header_size(receiver->pending);
    pack_header(receiver->pending, size < header ? 0u : size - header - CHECK_SIZE, head);
    receiver->awaits_echo = false;
    if (size < header || memcmp(body, head, header) != 0) {
        return UNIT_FAULT;
    }
    if (has_reply(receiver->pending)) {
        return UNIT_NONE;
    }
    receiver->is_pending = false;
    message->id = receiver->pending;
    return UNIT_ACK;
}

static unit_kind_t interpret(unit_receiver_t *receiver, const uint8_t *body, size_t size, unit_message_t *message)
{
    head_t head;
    uint8_t tail[@CHECK@];
    const size_t end = size < CHECK_SIZE ? 0u : size - CHECK_SIZE;
    if (receiver->awaits_echo) {
        return interpret_echo(receiver, body, size, message);
    }
    if (size < CHECK_SIZE || unpack_header(receiver, body, end, &head) != HEAD_WHOLE) {
        return UNIT_FAULT;
    }
    put_check(body, head.size, end, tail);
    if (memcmp(tail, &body[end], CHECK_SIZE) != 0 || !head.is_ours || !head.has_row
        || head.length != length_of(head.size, end - head.size)) {
        return UNIT_FAULT;
    }
    if (receiver->is_pending && receiver->pending == head.id && !head.is_unsolicited && head.is_final) {
        receiver->is_pending = false;
    }
    message->id = head.id;
    message->code = head.status;
    message->ticks = head.ticks;
    message->time = head.time;
    message->is_final = head.is_final;
    message->data = &body[head.size];
    message->size = end - head.size;
    if (head.is_refused) {
        return UNIT_NACK;
    }
    if (head.is_unsolicited) {
        return UNIT_UNSOLICITED;
    }
    return is_telecommand(head.id) ? UNIT_ACK : UNIT_TELEMETRY;
}
