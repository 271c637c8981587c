unit_kind_t unit_receive(unit_receiver_t *receiver, uint8_t byte, unit_message_t *message)
{
    (void)memmove(receiver->bytes, &receiver->bytes[receiver->taken], receiver->size - receiver->taken);
    receiver->size -= receiver->taken;
    receiver->taken = 0u;
    (void)memset(message, 0, sizeof *message);
    message->kind = advance(receiver, byte, message);
    return message->kind;
}
