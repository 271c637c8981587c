typedef struct {
    uint8_t *bytes;
    size_t capacity, size;
} output_t;

/* Content of a reply header. */
typedef struct {
    size_t size;
    long data_size; /* -1: invalid */
    bool is_ours, has_row, is_refused, is_unsolicited, is_final;
    uint32_t id, status;
    uint64_t ticks, time, length;
} head_t;

enum { HEAD_SHORT, HEAD_WHOLE, HEAD_BAD };
