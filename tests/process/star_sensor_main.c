/* The component of docs/c-export.md on a POSIX port: sets the clock, leaves standby, and prints the first valid attitude. */
#define _POSIX_C_SOURCE 200809L
#include "star_sensor.h"

#include <fcntl.h>
#include <poll.h>
#include <stdio.h>
#include <termios.h>
#include <time.h>
#include <unistd.h>

static void write_port(void *uart, const uint8_t *bytes, size_t size)
{
    if (write(*(int *)uart, bytes, size) != (ssize_t)size) {
        perror("write");
    }
}

static void wait_for_reply(star_sensor_t *sensor, int port)
{
    struct pollfd readable = {port, POLLIN, 0};
    uint8_t bytes[64];
    while (sensor->is_waiting) {
        if (poll(&readable, 1u, 1000) > 0) {
            const ssize_t size = read(port, bytes, sizeof bytes);
            star_sensor_received(sensor, bytes, size > 0 ? (size_t)size : 0u);
        } else {
            star_sensor_silent(sensor);
        }
    }
}

int main(int count, char **words)
{
    int port = open(count > 1 ? words[1] : "/dev/ttyUSB0", O_RDWR | O_NOCTTY);
    struct termios line = {0};
    star_sensor_t sensor;
    int tries;
    line.c_cflag = CS8 | CREAD | CLOCAL;
    (void)cfsetospeed(&line, B115200);
    (void)cfsetispeed(&line, B115200);
    if (port < 0 || tcsetattr(port, TCSANOW, &line) != 0) {
        perror("serial port");
        return 1;
    }
    star_sensor_init(&sensor, write_port, &port);
    (void)star_sensor_set_time(&sensor, 1700000000u);
    wait_for_reply(&sensor, port);
    (void)star_sensor_find_attitude(&sensor);
    wait_for_reply(&sensor, port);
    for (tries = 0; tries < 100 && !(sensor.attitudes > 0u && sensor.attitude.valid); ++tries) {
        const struct timespec pause = {0, 200000000};
        (void)star_sensor_request_attitude(&sensor);
        wait_for_reply(&sensor, port);
        (void)nanosleep(&pause, NULL);
    }
    printf("acknowledges %u, refusals %u, faults %u, lost %u\n", (unsigned)sensor.acknowledges,
           (unsigned)sensor.refusals, (unsigned)sensor.faults, (unsigned)sensor.lost);
    printf("valid %d, q %.6f %.6f %.6f %.6f\n", (int)sensor.attitude.valid, (double)sensor.attitude.q_x,
           (double)sensor.attitude.q_y, (double)sensor.attitude.q_z, (double)sensor.attitude.q_w);
    return 0;
}
