static uint64_t get_le(const uint8_t *data, unsigned size)
{
    uint64_t value = 0u;
    unsigned i;
    for (i = size; i > 0u; --i) {
        value = (value << 8) | data[i - 1u];
    }
    return value;
}

static uint64_t get_be(const uint8_t *data, unsigned size)
{
    uint64_t value = 0u;
    unsigned i;
    for (i = 0u; i < size; ++i) {
        value = (value << 8) | data[i];
    }
    return value;
}

static void put_le(uint8_t *data, unsigned size, uint64_t value)
{
    unsigned i;
    for (i = 0u; i < size; ++i) {
        const unsigned shift = 8u * i;
        data[i] = (uint8_t)((value >> shift) & 0xFFu);
    }
}

static void put_be(uint8_t *data, unsigned size, uint64_t value)
{
    unsigned i;
    for (i = 0u; i < size; ++i) {
        const unsigned shift = 8u * (size - 1u - i);
        data[i] = (uint8_t)((value >> shift) & 0xFFu);
    }
}

static int64_t to_signed(uint64_t value, unsigned bits)
{
    const unsigned shift = bits - 1u;
    const uint64_t sign = UINT64_C(1) << shift;
    const uint64_t inverted = (value ^ (sign - 1u)) & (sign - 1u); /* of a negative number n: -n - 1 */
    return (value & sign) != 0u ? (-(int64_t)inverted - 1) : (int64_t)value;
}

static float to_float(uint64_t raw)
{
    const uint32_t bits = (uint32_t)raw;
    float value;
    (void)memcpy(&value, &bits, sizeof value);
    return value;
}

static double to_double(uint64_t bits)
{
    double value;
    (void)memcpy(&value, &bits, sizeof value);
    return value;
}

static uint64_t float_bits(float value)
{
    uint32_t bits;
    (void)memcpy(&bits, &value, sizeof bits);
    return bits;
}

static uint64_t double_bits(double value)
{
    uint64_t bits;
    (void)memcpy(&bits, &value, sizeof bits);
    return bits;
}

/* Round half to even. False if the number is not within the limits after rounding. */
static bool to_raw(double value, double low, double high, uint64_t *raw)
{
    uint64_t whole;
    double size;
    double rest;
    if (!(value >= low - 0.5 && value <= high + 0.5)) {
        return false;
    }
    size = value < 0.0 ? -value : value;
    whole = size >= 18446744073709551615.0 ? UINT64_MAX : (uint64_t)size;
    rest = size - (double)whole;
    if (rest > 0.5 || (rest == 0.5 && (whole & 1u) != 0u)) {
        ++whole;
    }
    size = value < 0.0 ? -(double)whole : (double)whole;
    *raw = value < 0.0 ? (uint64_t)0 - whole : whole;
    return size >= low && size <= high;
}

/* The same in single precision, for numbers below 2^24. */
static bool to_raw_single(float value, float low, float high, uint64_t *raw)
{
    uint32_t whole;
    float size;
    float rest;
    if (!(value >= low - 0.5f && value <= high + 0.5f)) {
        return false;
    }
    size = value < 0.0f ? -value : value;
    whole = (uint32_t)size;
    rest = size - (float)whole;
    if (rest > 0.5f || (rest == 0.5f && (whole & 1u) != 0u)) {
        ++whole;
    }
    size = value < 0.0f ? -(float)whole : (float)whole;
    *raw = value < 0.0f ? (uint64_t)0 - whole : whole;
    return size >= low && size <= high;
}

static void get_text(const uint8_t *data, size_t size, char *text)
{
    (void)memcpy(text, data, size);
    text[size] = '\0';
}

/* Characters beyond 7 bits, or more than `size` characters, are rejected. */
static bool put_text(uint8_t *data, size_t size, const char *text)
{
    size_t i;
    for (i = 0u; i < size && text[i] != '\0'; ++i) {
        if ((unsigned char)text[i] > 127u) {
            return false;
        }
        data[i] = (uint8_t)text[i];
    }
    if (text[i] != '\0') {
        return false;
    }
    (void)memset(&data[i], 0, size - i);
    return true;
}
