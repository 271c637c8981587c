size_t unit_frame_request(uint32_t id, const uint8_t *data, size_t size, uint8_t *out, size_t capacity)
{
    output_t output = {out, capacity, 0u};
    uint8_t *body; /* at the end of `out`, so that framing can be written to its beginning */
    size_t header;
    size_t end;
    if (!is_row(id) || capacity < UNIT_REQUEST_CAPACITY(size)) {
        return 0u;
    }
    header = header_size(id);
    end = header + size;
    body = &out[capacity - end - CHECK_SIZE];
    pack_header(id, size, body);
    if (size > 0u) {
        (void)memmove(&body[header], data, size);
    }
    put_check(body, header, end, &body[end]);
    put_start(&output);
    put_body(&output, body, end + CHECK_SIZE);
    put_end(&output);
    return output.size;
}

void unit_receiver_init(unit_receiver_t *receiver)
{
    (void)memset(receiver, 0, sizeof *receiver);
}

void unit_expect(unit_receiver_t *receiver, uint32_t id)
{
    receiver->is_pending = true;
    receiver->pending = id;
    receiver->awaits_echo = has_echo(id);
}

unit_kind_t unit_give_up(unit_receiver_t *receiver)
{
    const bool is_open = receiver->size > receiver->taken;
    receiver->is_pending = false;
    receiver->awaits_echo = false;
    receiver->is_open = false;
    receiver->is_escaped = false;
    receiver->is_skipping = false;
    receiver->size = 0u;
    receiver->taken = 0u;
    return is_open ? UNIT_FAULT : UNIT_NONE;
}
