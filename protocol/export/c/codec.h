/* Results of encoding and decoding. Positive: position, from 1, of the first value outside its limits. */
#define UNIT_OK 0
#define UNIT_BAD_LENGTH (-1)

