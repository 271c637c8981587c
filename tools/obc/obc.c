/* A flight computer for the board MPS2 with a Cortex-M3 (QEMU: -machine mps2-an385), without an operating system.
 *
 * UART 0 is connected to the star tracker, UART 1 to the ground. The program sets the star tracker's clock, lets it find the
 * attitude, reads it five times per second, and checks length and progress. It reports each reading, and ends the machine: with
 * status 0 after 25 readings that are valid, with 1 if something was wrong. The codec is `starhil icd export c`.
 */
#include "cubestar.h"

#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>

#define CYCLE_MS 200u   /* five readings per second */
#define DEADLINE_MS 50u /* a later reply is late */
#define SILENCE_MS 1000u /* after which a reply is missing */
#ifndef LIMIT_MS
#define LIMIT_MS 120000u
#endif
#define WANTED 25u
#define UNIX_S 1774008000u /* 2026-03-20T12:00:00Z */
#define CLOCK_HZ 25000000u

/* --- the board --- */

typedef struct {
    volatile uint32_t data, state, control, interrupts, divider;
} uart_t;
#define TRACKER ((uart_t *)0x40004000u)
#define GROUND ((uart_t *)0x40005000u)
#define TX_FULL 1u
#define RX_FULL 2u
#define RX_INTERRUPT 8u
static volatile uint32_t *const systick = (volatile uint32_t *)0xE000E010u; /* control, reload, value */
static volatile uint32_t *const enabled = (volatile uint32_t *)0xE000E100u; /* interrupts: 0 is a byte of UART 0 */

static volatile uint32_t now_ms;

static void tick(void) { ++now_ms; }

static void byte_came(void) { TRACKER->interrupts = RX_FULL; }

static void wait(void) /* for the next tick, or a byte */
{
#ifndef BUSY /* the time of instructions does not pass while it sleeps */
    __asm__ volatile("wfi");
#endif
}

static void fault(void) { _Exit(1); }

extern uint32_t stack_top;
void _start(void); /* of newlib: clears memory, calls main, and ends the machine with its result, by semihosting */
__attribute__((section(".vectors"), used)) static void (*const vectors[17])(void) = {
    (void (*)(void))(&stack_top), _start, fault, fault, fault, fault, fault, 0, 0, 0, 0, fault, fault, 0, fault, tick, byte_came};

static void start_board(void)
{
    TRACKER->divider = GROUND->divider = CLOCK_HZ / 115200u;
    GROUND->control = 3u; /* send and receive */
    TRACKER->control = 3u | RX_INTERRUPT;
    *enabled = 1u;
    systick[1] = CLOCK_HZ / 1000u - 1u;
    systick[2] = 0u;
    systick[0] = 7u; /* core clock, interrupt, on */
}

static void send(uart_t *uart, const uint8_t *bytes, size_t size)
{
    for (size_t i = 0u; i < size; ++i) {
        while ((uart->state & TX_FULL) != 0u) {
        }
        uart->data = bytes[i];
    }
}

static void say(const char *format, ...)
{
    char line[128];
    va_list arguments;
    va_start(arguments, format);
    const int size = vsnprintf(line, sizeof line, format, arguments);
    va_end(arguments);
    send(GROUND, (const uint8_t *)line, (size_t)size);
}

/* --- the star tracker --- */

static cubestar_receiver_t link;
static uint32_t late, missing, slowest_ms;

/* Send a request and wait for its reply; returns the kind of the message, or CUBESTAR_NONE after a silence. */
static int ask(uint8_t id, const uint8_t *data, size_t size, cubestar_message_t *message)
{
    uint8_t frame[CUBESTAR_REQUEST_CAPACITY(CUBESTAR_TC_SET_UNIX_TIME_SIZE)];
    const size_t length = cubestar_frame_request(id, data, size, frame, sizeof frame);
    const uint32_t begin_ms = now_ms;
    (void)cubestar_give_up(&link);
    cubestar_expect(&link, id);
    send(TRACKER, frame, length);
    while (now_ms - begin_ms < SILENCE_MS) {
        if ((TRACKER->state & RX_FULL) != 0u) {
            const int kind = (int)cubestar_receive(&link, (uint8_t)TRACKER->data, message);
            if (kind != CUBESTAR_NONE) {
                const uint32_t took_ms = now_ms - begin_ms;
                late += took_ms > DEADLINE_MS ? 1u : 0u;
                slowest_ms = took_ms > slowest_ms ? took_ms : slowest_ms;
                return kind;
            }
        } else {
            wait();
        }
    }
    ++missing;
    return CUBESTAR_NONE;
}

/* Discard what arrives until the line is quiet: replies to requests from before the star tracker had booted. */
static void drain(void)
{
    for (uint32_t begin_ms = now_ms; now_ms - begin_ms < CYCLE_MS;) {
        if ((TRACKER->state & RX_FULL) != 0u) {
            (void)TRACKER->data;
            begin_ms = now_ms;
        } else {
            wait();
        }
    }
}

static bool command(uint8_t id, const uint8_t *data, size_t size)
{
    cubestar_message_t message;
    return ask(id, data, size, &message) == CUBESTAR_ACK;
}

static bool set_time(uint32_t unix_s)
{
    cubestar_tc_set_unix_time_t values = CUBESTAR_TC_SET_UNIX_TIME_INIT;
    uint8_t data[CUBESTAR_TC_SET_UNIX_TIME_SIZE];
    values.seconds = unix_s;
    return cubestar_tc_set_unix_time_encode(&values, data) == CUBESTAR_OK
        && command(CUBESTAR_TC_SET_UNIX_TIME_ID, data, sizeof data);
}

static bool find_attitude(void)
{
    cubestar_tc_set_mode_t values = CUBESTAR_TC_SET_MODE_INIT;
    uint8_t data[CUBESTAR_TC_SET_MODE_SIZE];
    values.mode = CUBESTAR_COMMANDED_MODE_LOST_IN_SPACE;
    return cubestar_tc_set_mode_encode(&values, data) == CUBESTAR_OK
        && command(CUBESTAR_TC_SET_MODE_ID, data, sizeof data);
}

static bool read_attitude(cubestar_tlm_precise_attitude_t *attitude)
{
    cubestar_message_t message;
    return ask(CUBESTAR_TLM_PRECISE_ATTITUDE_ID, NULL, 0u, &message) == CUBESTAR_TELEMETRY
        && cubestar_tlm_precise_attitude_decode(message.data, message.size, attitude) == CUBESTAR_OK;
}

int main(void)
{
    cubestar_tlm_precise_attitude_t attitude;
    uint32_t valid = 0u, wrong = 0u, due_ms = 0u, frame = 0u;
    start_board();
    cubestar_receiver_init(&link, CUBESTAR_DIALECT_B);
    say("boot\n");
    while (!(set_time(UNIX_S) && find_attitude()) && now_ms < LIMIT_MS) { /* the star tracker may boot later */
        drain();
    }
    say("finding the attitude\n");
    late = missing = slowest_ms = 0u;
    while (valid < WANTED && now_ms < LIMIT_MS) {
        while ((int32_t)(now_ms - due_ms) < 0) {
            wait();
        }
        due_ms = now_ms + CYCLE_MS;
        if (!read_attitude(&attitude) || !attitude.valid) {
            continue;
        }
        const float length2 = attitude.q_x * attitude.q_x + attitude.q_y * attitude.q_y + attitude.q_z * attitude.q_z
                            + attitude.q_w * attitude.q_w;
        wrong += length2 < 0.9999f || length2 > 1.0001f || attitude.frame_counter < frame ? 1u : 0u;
        frame = (uint32_t)attitude.frame_counter;
        ++valid;
        say("frame %lu q %ld %ld %ld %ld\n", frame, (long)(1e6f * attitude.q_x), (long)(1e6f * attitude.q_y),
            (long)(1e6f * attitude.q_z), (long)(1e6f * attitude.q_w));
    }
    say("valid %lu wrong %lu late %lu missing %lu slowest_ms %lu elapsed_ms %lu\n", valid, wrong, late, missing, slowest_ms, now_ms);
    return valid == WANTED && wrong == 0u ? 0 : 1;
}
