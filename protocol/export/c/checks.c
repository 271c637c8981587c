// none
static uint64_t check(uint64_t state, const uint8_t *bytes, size_t size)
{
    (void)bytes;
    (void)size;
    return state;
}

// sum
static uint64_t check(uint64_t state, const uint8_t *bytes, size_t size)
{
    while (size-- > 0u) {
        state += *bytes++;
    }
    return state;
}

// xor
static uint64_t check(uint64_t state, const uint8_t *bytes, size_t size)
{
    while (size-- > 0u) {
        state ^= *bytes++;
    }
    return state;
}

// xor16
static uint64_t check(uint64_t state, const uint8_t *bytes, size_t size)
{
    const uint64_t second = UINT64_C(1) << 32; /* set before the second byte of a word */
    while (size-- > 0u) {
        state ^= (state & second) != 0u ? *bytes : (uint64_t)*bytes << 8;
        state ^= second;
        ++bytes;
    }
    return state;
}

// fletcher16
static uint64_t check(uint64_t state, const uint8_t *bytes, size_t size)
{
    while (size-- > 0u) {
        const uint64_t lower = ((state & 0xFFu) + *bytes++) % MODULUS;
        state = ((state >> 8) + lower) % MODULUS << 8 | lower;
    }
    return state;
}

// crc
static uint64_t check(uint64_t state, const uint8_t *bytes, size_t size)
{
    unsigned bit;
    while (size-- > 0u) {
        for (bit = 0u; bit < 8u; ++bit) {
            const unsigned in = (unsigned)*bytes >> (CRC_REFLECTED ? bit : 7u - bit) & 1u;
            const unsigned out = (unsigned)(state >> (CRC_REFLECTED ? 0u : CRC_BITS - 1u)) & 1u;
            state = CRC_REFLECTED ? state >> 1 : (state << 1) & CRC_MASK;
            if (in != out) {
                state ^= CRC_POLYNOMIAL;
            }
        }
        ++bytes;
    }
    return state;
}

// xxh32
static uint32_t rotated(uint32_t value, unsigned bits)
{
    return value << bits | value >> (32u - bits);
}

static uint64_t check(uint64_t seed, const uint8_t *bytes, size_t size)
{
    const uint32_t p1 = 2654435761u;
    const uint32_t p2 = 2246822519u;
    const uint32_t p3 = 3266489917u;
    const uint32_t p4 = 668265263u;
    const uint32_t p5 = 374761393u;
    const uint8_t *end = bytes + size;
    uint32_t value = (uint32_t)seed + p5;
    if (size >= 16u) {
        uint32_t lanes[4];
        unsigned lane;
        lanes[0] = (uint32_t)seed + p1 + p2;
        lanes[1] = (uint32_t)seed + p2;
        lanes[2] = (uint32_t)seed;
        lanes[3] = (uint32_t)seed - p1;
        for (; end - bytes >= 16; bytes += 16) {
            for (lane = 0u; lane < 4u; ++lane) {
                lanes[lane] = rotated(lanes[lane] + (uint32_t)get_le(bytes + 4u * lane, 4u) * p2, 13u) * p1;
            }
        }
        value = rotated(lanes[0], 1u) + rotated(lanes[1], 7u) + rotated(lanes[2], 12u) + rotated(lanes[3], 18u);
    }
    value += (uint32_t)size;
    for (; end - bytes >= 4; bytes += 4) {
        value = rotated(value + (uint32_t)get_le(bytes, 4u) * p3, 17u) * p4;
    }
    for (; bytes < end; ++bytes) {
        value = rotated(value + *bytes * p5, 11u) * p1;
    }
    value = (value ^ value >> 15) * p2;
    value = (value ^ value >> 13) * p3;
    return value ^ value >> 16;
}
