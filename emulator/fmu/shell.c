/* The star tracker as a Functional Mock-up Unit, versions 2.0 and 3.0, for co-simulation.
 *
 * A step sends the inputs to the live feed of an emulator on the stepped clock, waits for the answer in lock-step, and reads the
 * last measurement from the control channel. The shell starts the emulator and ends it, or connects to one that runs. The inputs
 * of a step are those at its begin: the emulator is one step behind the simulation.
 *
 * The emulator runs under a shell that ends it when its standard input ends, which is a pipe from this process: it ends with
 * this process, however this process ends. `model.h` is generated with the description: the variables and their start values.
 */
#define _GNU_SOURCE
#include "model.h"

#include <errno.h>
#include <fcntl.h>
#include <locale.h>
#include <math.h>
#include <netdb.h>
#include <poll.h>
#include <signal.h>
#include <spawn.h>
#include <stdarg.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <sys/un.h>
#include <sys/wait.h>
#include <time.h>
#include <unistd.h>

#define EXPORT __attribute__((visibility("default")))
#define LINE 16384
#define START_MS 300000 /* the first start on a machine compiles kernels */
#define ANSWER_MS 60000
#define END_MS 10000

extern char **environ;

enum status { OK = 0, WARNING = 1, ERROR = 3 };
typedef void (*logger3)(void *environment, int status, const char *category, const char *message);
typedef void (*logger2)(void *environment, const char *instance, int status, const char *category, const char *message, ...);
struct callbacks2 {
    logger2 logger;
    void *(*allocate)(size_t, size_t);
    void (*release)(void *);
    void (*finished)(void *, int);
    void *environment;
};

struct stream {
    int descriptor;
    size_t filled;
    char bytes[LINE];
};

struct unit {
    double numbers[VARIABLES];
    char *texts[VARIABLES];
    struct stream feed, control, output;
    int lifeline; /* write end of the pipe whose end ends the emulator */
    pid_t process;
    char name[64], said[512];
    logger3 log3;
    logger2 log2;
    void *environment;
};

static int report(struct unit *unit, enum status status, const char *format, ...)
{
    const char *category = status == ERROR ? "logStatusError" : "logStatusWarning";
    char message[1024];
    va_list arguments;
    va_start(arguments, format);
    (void)vsnprintf(message, sizeof message, format, arguments);
    va_end(arguments);
    if (unit->log3 != NULL) {
        unit->log3(unit->environment, status, category, message);
    } else if (unit->log2 != NULL) {
        unit->log2(unit->environment, unit->name, status, category, "%s", message);
    }
    return status;
}

/* --- lines over descriptors --- */

static void close_stream(struct stream *stream)
{
    if (stream->descriptor >= 0) {
        (void)close(stream->descriptor);
    }
    stream->descriptor = -1;
    stream->filled = 0u;
}

/* Read a line of at most LINE bytes into `line`. Returns false at the end of the stream, or if none arrives in time. */
static bool read_line(struct stream *stream, char *line, int patience_ms)
{
    for (;;) {
        char *end = memchr(stream->bytes, '\n', stream->filled);
        if (end != NULL) {
            const size_t size = (size_t)(end - stream->bytes);
            memcpy(line, stream->bytes, size);
            line[size] = '\0';
            stream->filled -= size + 1u;
            memmove(stream->bytes, end + 1, stream->filled);
            return true;
        }
        struct pollfd readable = {stream->descriptor, POLLIN, 0};
        int ready = 0;
        if (stream->filled == LINE) {
            stream->filled = 0u; /* longer than any line of the emulator */
            return false;
        }
        do {
            ready = stream->descriptor < 0 ? 0 : poll(&readable, 1u, patience_ms);
        } while (ready < 0 && errno == EINTR); /* a signal of the host */
        if (ready <= 0) {
            return false;
        }
        const ssize_t count = read(stream->descriptor, stream->bytes + stream->filled, LINE - stream->filled);
        if (count <= 0) {
            return false;
        }
        stream->filled += (size_t)count;
    }
}

/* Keep the emulator's output from filling its pipe; its last line explains an end. */
static void read_output(struct unit *unit, bool as_warnings)
{
    char line[LINE];
    while (unit->output.descriptor >= 0 && read_line(&unit->output, line, 0)) {
        (void)snprintf(unit->said, sizeof unit->said, "%.500s", line);
        if (as_warnings) {
            (void)report(unit, WARNING, "emulator: %s", line);
        }
    }
}

static bool ask(struct stream *stream, const char *request, char *answer)
{
    size_t sent = 0u;
    const size_t size = strlen(request);
    while (sent < size) {
        const ssize_t count = send(stream->descriptor, request + sent, size - sent, MSG_NOSIGNAL);
        if (count <= 0) {
            return false;
        }
        sent += (size_t)count;
    }
    return read_line(stream, answer, ANSWER_MS);
}

/* Connect to unix:/PATH, tcp:HOST:PORT or HOST:PORT. */
static bool connect_to(struct stream *stream, const char *address)
{
    close_stream(stream);
    if (strncmp(address, "unix:", 5u) == 0) {
        struct sockaddr_un place = {.sun_family = AF_UNIX};
        (void)snprintf(place.sun_path, sizeof place.sun_path, "%.*s", (int)sizeof place.sun_path - 1, address + 5);
        stream->descriptor = socket(AF_UNIX, SOCK_STREAM | SOCK_CLOEXEC, 0);
        return stream->descriptor >= 0 && connect(stream->descriptor, (struct sockaddr *)&place, sizeof place) == 0;
    }
    char host[256];
    (void)snprintf(host, sizeof host, "%s", strncmp(address, "tcp:", 4u) == 0 ? address + 4 : address);
    char *port = strrchr(host, ':');
    struct addrinfo hints = {.ai_family = AF_INET, .ai_socktype = SOCK_STREAM}, *found = NULL;
    if (port == NULL) {
        return false;
    }
    *port++ = '\0';
    if (getaddrinfo(host, port, &hints, &found) != 0) {
        return false;
    }
    stream->descriptor = socket(AF_INET, SOCK_STREAM | SOCK_CLOEXEC, 0);
    const bool done = stream->descriptor >= 0 && connect(stream->descriptor, found->ai_addr, found->ai_addrlen) == 0;
    freeaddrinfo(found);
    return done;
}

/* --- the emulator --- */

static void end_emulator(struct unit *unit)
{
    close_stream(&unit->feed);
    close_stream(&unit->control);
    if (unit->process <= 0) {
        return;
    }
    (void)close(unit->lifeline);
    for (int waited_ms = 0; waitpid(unit->process, NULL, WNOHANG) == 0; waited_ms += 10) {
        const struct timespec pause = {0, 10000000};
        read_output(unit, false);
        if (waited_ms == END_MS) {
            (void)kill(-unit->process, SIGKILL);
        }
        (void)nanosleep(&pause, NULL);
    }
    close_stream(&unit->output);
    unit->process = 0;
}

static bool start_emulator(struct unit *unit)
{
    static const char script[] = "\"$@\" 2>&1 & exec >/dev/null; read end; kill $! 2>&1; wait";
    char seed[32], convention[64], order[64], link[4096];
    int input[2], output[2];
    (void)snprintf(seed, sizeof seed, "%d", (int)unit->numbers[SEED]);
    (void)snprintf(convention, sizeof convention, "truth.convention=%s", unit->texts[CONVENTION]);
    (void)snprintf(order, sizeof order, "truth.order=%s", unit->texts[ORDER]);
    (void)snprintf(link, sizeof link, "links.serial.symlink=%s", unit->texts[SYMLINK]);
    const char *words[] = {
        "/bin/sh", "-c", script, "sh", unit->texts[COMMAND], "run", unit->texts[PROFILE], "--clock", "stepped", "--seed", seed,
        "--serial", unit->texts[SERIAL], "--can", unit->texts[CAN], "--control", "auto", "--set", "truth.kind=live",
        "--set", "truth.protocol=tcp", "--set", "truth.port=0", "--set", "truth.lockstep=true",
        "--set", convention, "--set", order, unit->texts[SYMLINK][0] != '\0' ? "--set" : NULL, link, NULL};
    posix_spawn_file_actions_t actions;
    posix_spawnattr_t attributes;
    if (pipe2(input, O_CLOEXEC) != 0) {
        return false;
    }
    if (pipe2(output, O_CLOEXEC) != 0) {
        (void)close(input[0]);
        (void)close(input[1]);
        return false;
    }
    (void)posix_spawn_file_actions_init(&actions);
    (void)posix_spawn_file_actions_adddup2(&actions, input[0], STDIN_FILENO);
    (void)posix_spawn_file_actions_adddup2(&actions, output[1], STDOUT_FILENO);
    (void)posix_spawnattr_init(&attributes);
    (void)posix_spawnattr_setflags(&attributes, POSIX_SPAWN_SETPGROUP); /* Ctrl-C in the host's terminal does not reach it */
    if (posix_spawn(&unit->process, "/bin/sh", &actions, &attributes, (char *const *)words, environ) != 0) {
        unit->process = 0;
    }
    (void)posix_spawnattr_destroy(&attributes);
    (void)posix_spawn_file_actions_destroy(&actions);
    (void)close(input[0]);
    (void)close(output[1]);
    unit->lifeline = input[1];
    unit->output.descriptor = output[0];
    return unit->process > 0;
}

/* Copy the value of NAME=VALUE from the ready line. */
static bool field(const char *line, const char *name, char *value, size_t size)
{
    const char *found = strstr(line, name);
    if (found == NULL) {
        return false;
    }
    found += strlen(name);
    (void)snprintf(value, size, "%.*s", (int)strcspn(found, " \n"), found);
    return true;
}

static int begin(struct unit *unit)
{
    char feed[256], control[256], line[LINE];
    (void)snprintf(feed, sizeof feed, "%s", unit->texts[FEED]);
    (void)snprintf(control, sizeof control, "%s", unit->texts[CONTROL]);
    if (feed[0] == '\0') {
        if (!start_emulator(unit)) {
            return report(unit, ERROR, "no process for the emulator: %s", strerror(errno));
        }
        do {
            if (!read_line(&unit->output, line, START_MS)) {
                end_emulator(unit);
                return report(unit, ERROR, "%s does not start: %s", unit->texts[COMMAND], unit->said);
            }
            (void)snprintf(unit->said, sizeof unit->said, "%.500s", line);
        } while (strncmp(line, "ready ", 6u) != 0);
        if (!field(line, " truth=", feed, sizeof feed) || !field(line, " control=", control, sizeof control)) {
            end_emulator(unit);
            return report(unit, ERROR, "the emulator names no feed and control channel: %s", line);
        }
        (void)fcntl(unit->output.descriptor, F_SETFL, O_NONBLOCK);
        free(unit->texts[READY]);
        unit->texts[READY] = strdup(line);
    }
    if (!connect_to(&unit->feed, feed) || !connect_to(&unit->control, control)) {
        end_emulator(unit);
        return report(unit, ERROR, "no emulator at %s and %s: %s", feed, control, strerror(errno));
    }
    return OK;
}

static int lost(struct unit *unit, const char *during)
{
    read_output(unit, false);
    end_emulator(unit);
    return report(unit, ERROR, "the emulator has ended or does not answer (%s); its last line: %s", during, unit->said);
}

/* Take the outputs from the row of the last measurement; what it does not have, such as the attitude of an invalid one, stays. */
static void read_outputs(struct unit *unit, const char *row)
{
    for (int index = 0; index < VARIABLES; ++index) {
        char key[64];
        if (KEYS[index] == NULL || snprintf(key, sizeof key, "\"%s\": ", KEYS[index]) < 0) {
            continue;
        }
        const char *value = strstr(row, key);
        if (value == NULL) {
            continue;
        }
        value += strlen(key);
        if (*value == '"') {
            free(unit->texts[index]);
            unit->texts[index] = strndup(value + 1, strcspn(value + 1, "\""));
        } else if (strncmp(value, "null", 4u) != 0) {
            unit->numbers[index] = *value == 't' ? 1.0 : *value == 'f' ? 0.0 : strtod(value, NULL);
        }
    }
}

static size_t add_vector(char *text, size_t size, const char *name, const double *numbers, int count)
{
    size_t length = (size_t)snprintf(text, size, ", \"%s\": [", name);
    for (int index = 0; index < count; ++index) {
        length += (size_t)snprintf(text + length, size - length, "%s%.17g", index > 0 ? ", " : "", numbers[index]);
    }
    return length + (size_t)snprintf(text + length, size - length, "]");
}

static int step(struct unit *unit, double time, double size)
{
    const double *numbers = unit->numbers, *position = numbers + POSITION_X;
    char message[2048], answer[LINE];
    const locale_t c_locale = newlocale(LC_ALL_MASK, "C", (locale_t)0);
    const locale_t hosts = uselocale(c_locale); /* the decimal point of numbers */
    size_t length = (size_t)snprintf(message, sizeof message, "{\"t\": %.9f", time);
    length += add_vector(message + length, sizeof message - length, "q", numbers + Q_1, 4);
    if (numbers[CHECK_RATES] != 0.0) {
        length += add_vector(message + length, sizeof message - length, "rate", numbers + RATE_X, 3);
    }
    if (position[0] != 0.0 || position[1] != 0.0 || position[2] != 0.0) {
        length += add_vector(message + length, sizeof message - length, "position_m", position, 3);
        length += add_vector(message + length, sizeof message - length, "velocity_m_s", numbers + VELOCITY_X, 3);
    }
    if (numbers[UNIX_S] != 0.0) {
        length += (size_t)snprintf(message + length, sizeof message - length, ", \"unix_s\": %.9f", numbers[UNIX_S]);
    }
    (void)snprintf(message + length, sizeof message - length, "}\n");
    int status = OK;
    if (!ask(&unit->feed, message, answer)) {
        status = lost(unit, "step");
    } else if (strncmp(answer, "{\"ok\": true", 11u) != 0) {
        status = report(unit, ERROR, "inputs at %g s rejected: %s", time, answer);
    } else if (!ask(&unit->control, "{\"do\": \"frames\"}\n", answer)) {
        status = lost(unit, "measurement");
    } else {
        read_outputs(unit, answer);
        unit->numbers[TIME] = time + size;
        read_output(unit, true);
    }
    (void)uselocale(hosts);
    freelocale(c_locale);
    return status;
}

/* --- instances and values, for both versions --- */

static void clear(struct unit *unit)
{
    end_emulator(unit);
    for (int index = 0; index < VARIABLES; ++index) {
        unit->numbers[index] = START_NUMBERS[index];
        free(unit->texts[index]);
        unit->texts[index] = strdup(START_TEXTS[index]);
    }
    unit->said[0] = '\0';
}

static struct unit *make(const char *name, const char *token, logger3 log3, logger2 log2, void *environment)
{
    struct unit *unit = calloc(1u, sizeof *unit);
    if (unit == NULL) {
        return NULL;
    }
    unit->log3 = log3;
    unit->log2 = log2;
    unit->environment = environment;
    unit->feed.descriptor = unit->control.descriptor = unit->output.descriptor = -1;
    (void)snprintf(unit->name, sizeof unit->name, "%.63s", name);
    if (strcmp(token, TOKEN) != 0) {
        (void)report(unit, ERROR, "the instantiation token is not that of this FMU");
        free(unit);
        return NULL;
    }
    clear(unit);
    return unit;
}

static void drop(struct unit *unit)
{
    if (unit != NULL) {
        end_emulator(unit);
        for (int index = 0; index < VARIABLES; ++index) {
            free(unit->texts[index]);
        }
        free(unit);
    }
}

/* Getter and setter of a type: the values of variables by their references. */
#define FOR_EACH(BODY)                                                                                                             \
    for (size_t index = 0; index < count; ++index) {                                                                               \
        const uint32_t variable = references[index];                                                                               \
        if (variable >= VARIABLES) {                                                                                               \
            return ERROR;                                                                                                          \
        }                                                                                                                          \
        BODY                                                                                                                       \
    }                                                                                                                              \
    return OK;
#define ACCESS(VERSION, NAME, TYPE, GET, SET, ...)                                                                                 \
    EXPORT int VERSION##Get##NAME(struct unit *unit, const uint32_t *references, size_t count, TYPE *values __VA_ARGS__)           \
    {                                                                                                                              \
        FOR_EACH(GET)                                                                                                              \
    }                                                                                                                              \
    EXPORT int VERSION##Set##NAME(struct unit *unit, const uint32_t *references, size_t count, const TYPE *values __VA_ARGS__)     \
    {                                                                                                                              \
        FOR_EACH(SET)                                                                                                              \
    }
#define NUMBER(VERSION, NAME, TYPE, ...)                                                                                           \
    ACCESS(VERSION, NAME, TYPE, values[index] = (TYPE)unit->numbers[variable];,                                                    \
           unit->numbers[variable] = (double)values[index];, __VA_ARGS__)
#define TEXT(VERSION, ...)                                                                                                         \
    ACCESS(VERSION, String, char *, values[index] = unit->texts[variable];, free(unit->texts[variable]);                           \
           unit->texts[variable] = strdup(values[index]);, __VA_ARGS__)
#define SIZE , size_t size __attribute__((unused))

NUMBER(fmi2, Real, double, )
NUMBER(fmi2, Integer, int, )
NUMBER(fmi2, Boolean, int, )
NUMBER(fmi3, Float64, double, SIZE)
NUMBER(fmi3, Int32, int32_t, SIZE)
NUMBER(fmi3, Boolean, bool, SIZE)
TEXT(fmi2, )
TEXT(fmi3, SIZE)

/* Functions whose only argument that matters is the instance: of both versions, and those that have nothing to do. */
#define BOTH(NAME, BODY)                                                                                                           \
    EXPORT int fmi2##NAME(struct unit *unit) { BODY }                                                                              \
    EXPORT int fmi3##NAME(struct unit *unit) { BODY }
#define NOTHING(NAME) EXPORT int NAME(struct unit *unit __attribute__((unused))) { return OK; }
#define UNSUPPORTED(NAME) EXPORT int NAME(struct unit *unit) { return report(unit, ERROR, #NAME ": not supported"); }

BOTH(ExitInitializationMode, return begin(unit);)
BOTH(Terminate, end_emulator(unit); return OK;)
BOTH(Reset, clear(unit); return OK;)
EXPORT void fmi2FreeInstance(struct unit *unit) { drop(unit); }
EXPORT void fmi3FreeInstance(struct unit *unit) { drop(unit); }
NOTHING(fmi2SetDebugLogging) NOTHING(fmi2SetupExperiment) NOTHING(fmi2EnterInitializationMode)
NOTHING(fmi3SetDebugLogging) NOTHING(fmi3EnterInitializationMode)
UNSUPPORTED(fmi2CancelStep) UNSUPPORTED(fmi2DeSerializeFMUstate) UNSUPPORTED(fmi2FreeFMUstate) UNSUPPORTED(fmi2GetBooleanStatus)
UNSUPPORTED(fmi2GetDirectionalDerivative) UNSUPPORTED(fmi2GetFMUstate) UNSUPPORTED(fmi2GetIntegerStatus)
UNSUPPORTED(fmi2GetRealOutputDerivatives) UNSUPPORTED(fmi2GetRealStatus) UNSUPPORTED(fmi2GetStatus)
UNSUPPORTED(fmi2GetStringStatus) UNSUPPORTED(fmi2SerializeFMUstate) UNSUPPORTED(fmi2SerializedFMUstateSize)
UNSUPPORTED(fmi2SetFMUstate) UNSUPPORTED(fmi2SetRealInputDerivatives)
UNSUPPORTED(fmi3ActivateModelPartition) UNSUPPORTED(fmi3CompletedIntegratorStep) UNSUPPORTED(fmi3DeserializeFMUState)
UNSUPPORTED(fmi3EnterConfigurationMode) UNSUPPORTED(fmi3EnterContinuousTimeMode) UNSUPPORTED(fmi3EnterEventMode)
UNSUPPORTED(fmi3EnterStepMode) UNSUPPORTED(fmi3EvaluateDiscreteStates) UNSUPPORTED(fmi3ExitConfigurationMode)
UNSUPPORTED(fmi3FreeFMUState) UNSUPPORTED(fmi3GetAdjointDerivative) UNSUPPORTED(fmi3GetBinary) UNSUPPORTED(fmi3GetClock)
UNSUPPORTED(fmi3GetContinuousStateDerivatives) UNSUPPORTED(fmi3GetContinuousStates) UNSUPPORTED(fmi3GetDirectionalDerivative)
UNSUPPORTED(fmi3GetEventIndicators) UNSUPPORTED(fmi3GetFMUState) UNSUPPORTED(fmi3GetFloat32) UNSUPPORTED(fmi3GetInt16)
UNSUPPORTED(fmi3GetInt64) UNSUPPORTED(fmi3GetInt8) UNSUPPORTED(fmi3GetIntervalDecimal) UNSUPPORTED(fmi3GetIntervalFraction)
UNSUPPORTED(fmi3GetNominalsOfContinuousStates) UNSUPPORTED(fmi3GetNumberOfContinuousStates)
UNSUPPORTED(fmi3GetNumberOfEventIndicators) UNSUPPORTED(fmi3GetNumberOfVariableDependencies)
UNSUPPORTED(fmi3GetOutputDerivatives) UNSUPPORTED(fmi3GetShiftDecimal) UNSUPPORTED(fmi3GetShiftFraction)
UNSUPPORTED(fmi3GetUInt16) UNSUPPORTED(fmi3GetUInt32) UNSUPPORTED(fmi3GetUInt64) UNSUPPORTED(fmi3GetUInt8)
UNSUPPORTED(fmi3GetVariableDependencies) UNSUPPORTED(fmi3SerializeFMUState) UNSUPPORTED(fmi3SerializedFMUStateSize)
UNSUPPORTED(fmi3SetBinary) UNSUPPORTED(fmi3SetClock) UNSUPPORTED(fmi3SetContinuousStates) UNSUPPORTED(fmi3SetFMUState)
UNSUPPORTED(fmi3SetFloat32) UNSUPPORTED(fmi3SetInt16) UNSUPPORTED(fmi3SetInt64) UNSUPPORTED(fmi3SetInt8)
UNSUPPORTED(fmi3SetIntervalDecimal) UNSUPPORTED(fmi3SetIntervalFraction) UNSUPPORTED(fmi3SetShiftDecimal)
UNSUPPORTED(fmi3SetShiftFraction) UNSUPPORTED(fmi3SetTime) UNSUPPORTED(fmi3SetUInt16) UNSUPPORTED(fmi3SetUInt32)
UNSUPPORTED(fmi3SetUInt64) UNSUPPORTED(fmi3SetUInt8) UNSUPPORTED(fmi3UpdateDiscreteStates)
EXPORT void *fmi3InstantiateModelExchange(void) { return NULL; }
EXPORT void *fmi3InstantiateScheduledExecution(void) { return NULL; }

/* --- version 2.0 --- */

EXPORT const char *fmi2GetVersion(void) { return "2.0"; }
EXPORT const char *fmi2GetTypesPlatform(void) { return "default"; }

EXPORT void *fmi2Instantiate(const char *name, int type, const char *token, const char *resources,
                             const struct callbacks2 *callbacks, int visible, int logging)
{
    (void)resources, (void)visible, (void)logging;
    return type == 1 ? make(name, token, NULL, callbacks->logger, callbacks->environment) : NULL;
}

EXPORT int fmi2DoStep(struct unit *unit, double time, double size, int is_new)
{
    (void)is_new;
    return step(unit, time, size);
}

/* --- version 3.0 --- */

EXPORT const char *fmi3GetVersion(void) { return "3.0"; }

EXPORT void *fmi3InstantiateCoSimulation(const char *name, const char *token, const char *resources, bool visible, bool logging,
                                         bool events, bool early, const uint32_t *required, size_t count, void *environment,
                                         logger3 log, void *update)
{
    (void)resources, (void)visible, (void)logging, (void)events, (void)early, (void)required, (void)count, (void)update;
    return make(name, token, log, NULL, environment);
}

EXPORT int fmi3DoStep(struct unit *unit, double time, double size, bool is_new, bool *event, bool *terminate, bool *early,
                      double *last)
{
    (void)is_new;
    *event = *terminate = *early = false;
    const int status = step(unit, time, size);
    *last = status == OK ? time + size : time;
    return status;
}
