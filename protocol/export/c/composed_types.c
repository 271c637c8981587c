typedef struct {
    uint8_t *bytes;
    size_t capacity;
    size_t size;
} output_t;

/* Content of a reply header. */
typedef struct {
    size_t size;
    long data_size; /* -1: invalid */
    bool is_ours;
    bool has_row;
    bool is_refused;
    bool is_unsolicited;
    bool is_final;
    uint32_t id;
    uint32_t status;
    uint64_t ticks;
    uint64_t time;
    uint64_t length;
} head_t;

enum { HEAD_SHORT, HEAD_WHOLE, HEAD_BAD };
