/* The star tracker as a Functional Mock-up Unit, versions 2.0 and 3.0, for co-simulation.
 *
 * The shell holds the values of all variables and exchanges them with the process `starhil fmu serve`, in one packet each way. The
 * first exchange starts the emulator or connects to one, each further one is a step. That process ends when this end of their
 * socket is closed, thus also with this process, however it ends. `model.h` is generated with the description of the variables.
 */
#define _GNU_SOURCE
#include "model.h"

#include <errno.h>
#include <math.h>
#include <spawn.h>
#include <stdarg.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <sys/wait.h>
#include <unistd.h>

#define EXPORT __attribute__((visibility("default")))
extern char **environ;

enum status { OK = 0, WARNING = 1, ERROR = 3 };
enum phase { PREPARING, RUNNING, ENDED };
#define SHORTEST_STEP 1e-9 /* the resolution of the emulator's time, seconds */
#define GAP 1e-3           /* between two steps, as a share of the second: more than rounding */

enum kind { FLOAT64, INT32, BOOLEAN, STRING };
enum causality { INDEPENDENT, INPUT, OUTPUT, PARAMETER };
static const struct variable {
    const char *name;
    enum kind kind;
    enum causality causality;
} VARIABLES[] = VARIABLES_OF_MODEL;
typedef void (*logger3)(void *environment, int status, const char *category, const char *message);
typedef void (*logger2)(void *environment, const char *instance, int status, const char *category, const char *message, ...);
struct callbacks2 {
    logger2 logger;
    void *(*allocate)(size_t, size_t);
    void (*release)(void *);
    void (*finished)(void *, int);
    void *environment;
};

struct values { /* the packet */
    double numbers[NUMBERS];
    char texts[TEXTS][TEXT_SIZE];
    char message[TEXT_SIZE]; /* for the host's log, with `status` */
    int status;
};

struct unit {
    struct values values;
    enum phase phase;
    bool stepped;
    int link;
    pid_t process;
    char name[64];
    logger3 log3;
    logger2 log2;
    void *environment;
};

static int report(struct unit *unit, enum status status, const char *format, ...)
{
    const char *category = status == ERROR ? "logStatusError" : "logStatusWarning";
    char message[TEXT_SIZE + 256];
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

/* --- the process of the emulator --- */

static void end(struct unit *unit)
{
    if (unit->process > 0) {
        (void)close(unit->link);
        while (waitpid(unit->process, NULL, 0) < 0 && errno == EINTR) {
        }
    }
    unit->link = -1;
    unit->process = 0;
    unit->phase = ENDED;
}

static int exchange(struct unit *unit)
{
    ssize_t size;
    do {
        size = send(unit->link, &unit->values, sizeof unit->values, MSG_NOSIGNAL);
    } while (size < 0 && errno == EINTR); /* a signal of the host */
    if (size > 0) {
        do {
            size = recv(unit->link, &unit->values, sizeof unit->values, 0);
        } while (size < 0 && errno == EINTR);
    }
    if (size != (ssize_t)sizeof unit->values) {
        end(unit);
        return report(unit, ERROR, "%s fmu serve has ended without an answer", unit->values.texts[COMMAND]);
    }
    if (unit->values.message[0] != '\0') {
        (void)report(unit, unit->values.status, "%s", unit->values.message);
    }
    if (unit->values.status != ERROR) {
        return OK;
    }
    end(unit);
    return ERROR;
}

static int begin(struct unit *unit)
{
    char *command = unit->values.texts[COMMAND], *words[] = {command, "fmu", "serve", NULL};
    int ends[2], fault;
    posix_spawn_file_actions_t actions;
    posix_spawnattr_t attributes;
    if (unit->phase != PREPARING) {
        return report(unit, ERROR, "a simulation has begun already; reset the FMU to begin another");
    }
    if (socketpair(AF_UNIX, SOCK_SEQPACKET | SOCK_CLOEXEC, 0, ends) != 0) {
        return report(unit, ERROR, "no socket: %s", strerror(errno));
    }
    (void)posix_spawn_file_actions_init(&actions);
    (void)posix_spawn_file_actions_adddup2(&actions, ends[1], STDIN_FILENO);
    (void)posix_spawnattr_init(&attributes);
    (void)posix_spawnattr_setflags(&attributes, POSIX_SPAWN_SETPGROUP); /* Ctrl-C in the host's terminal does not reach it */
    fault = posix_spawnp(&unit->process, command, &actions, &attributes, words, environ);
    (void)posix_spawnattr_destroy(&attributes);
    (void)posix_spawn_file_actions_destroy(&actions);
    (void)close(ends[1]);
    unit->link = ends[0];
    if (fault != 0) {
        (void)close(ends[0]);
        unit->process = 0;
        return report(unit, ERROR, "%s does not start: %s", command, strerror(fault));
    }
    unit->phase = RUNNING;
    return exchange(unit);
}

/* A step of the importer's; the inputs are those at its beginning. */
static int step(struct unit *unit, double time, double size)
{
    const double end_of_last = unit->values.numbers[TIME];
    if (unit->phase != RUNNING) {
        return report(unit, ERROR, unit->phase == ENDED ? "step at %g s: the simulation has ended; reset the FMU to begin another"
                                                        : "step at %g s: the simulation begins when the initialization mode ends", time);
    }
    if (!isfinite(time) || !isfinite(size) || size < SHORTEST_STEP) {
        return report(unit, ERROR, "step at %g s: its size is %g s; it must be at least %g s", time, size, SHORTEST_STEP);
    }
    if (unit->stepped && fabs(time - end_of_last) > GAP * size) {
        return report(unit, ERROR, "step at %.9g s: it must begin where the last one has ended, at %.9g s", time, end_of_last);
    }
    unit->values.numbers[TIME] = time;
    const int status = exchange(unit);
    if (status == OK) {
        unit->stepped = true;
        unit->values.numbers[TIME] = time + size;
    }
    return status;
}

static int set_start(struct unit *unit, double time)
{
    if (unit->phase != PREPARING || !isfinite(time)) {
        return report(unit, ERROR, "start at %g s: must be a time, given before the simulation begins; reset the FMU to begin another", time);
    }
    unit->values.numbers[TIME] = time;
    return OK;
}

/* --- instances and values, for both versions --- */

static int clear(struct unit *unit)
{
    static const struct values start = {.numbers = START_NUMBERS, .texts = START_TEXTS};
    end(unit);
    unit->values = start;
    unit->phase = PREPARING;
    unit->stepped = false;
    return OK;
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
    (void)snprintf(unit->name, sizeof unit->name, "%.63s", name);
    if (strcmp(token, TOKEN) != 0) {
        (void)report(unit, ERROR, "the instantiation token is not that of this FMU");
        free(unit);
        return NULL;
    }
    (void)clear(unit);
    return unit;
}

static void drop(struct unit *unit)
{
    if (unit != NULL) {
        end(unit);
        free(unit);
    }
}

static int set_text(struct unit *unit, uint32_t number, const char *text)
{
    return snprintf(unit->values.texts[number], TEXT_SIZE, "%s", text) < TEXT_SIZE ? OK : report(unit, ERROR, "a text is too long");
}

static int check_kind(struct unit *unit, uint32_t reference, enum kind kind)
{
    if (reference < NUMBERS + TEXTS && VARIABLES[reference].kind == kind) {
        return OK;
    }
    return report(unit, ERROR, "value reference %u: not a variable of this type", (unsigned)reference);
}

static int check_settable(struct unit *unit, uint32_t reference, enum kind kind)
{
    if (check_kind(unit, reference, kind) != OK) {
        return ERROR;
    }
    const struct variable *variable = &VARIABLES[reference];
    if (variable->causality == INDEPENDENT) {
        return report(unit, ERROR, "%s: cannot be set; it follows from the steps", variable->name);
    }
    if (variable->causality != INPUT && unit->phase != PREPARING) {
        return report(unit, ERROR, "%s: not an input; it can be set only before the simulation begins", variable->name);
    }
    return OK;
}

/* Getter and setter of a type: the values of COUNT variables by their references. */
#define FOR_EACH(CHECK, KIND, BODY)                                                                                                \
    for (size_t index = 0; index < count; ++index) {                                                                               \
        const uint32_t variable = references[index];                                                                               \
        if (CHECK(unit, variable, KIND) != OK) {                                                                                   \
            return ERROR;                                                                                                          \
        }                                                                                                                          \
        BODY                                                                                                                       \
    }                                                                                                                              \
    return OK;
#define ACCESS(VERSION, NAME, TYPE, KIND, GET, SET, ...)                                                                           \
    EXPORT int VERSION##Get##NAME(struct unit *unit, const uint32_t *references, size_t count, TYPE *values __VA_ARGS__)           \
    {                                                                                                                              \
        FOR_EACH(check_kind, KIND, GET)                                                                                            \
    }                                                                                                                              \
    EXPORT int VERSION##Set##NAME(struct unit *unit, const uint32_t *references, size_t count, const TYPE *values __VA_ARGS__)     \
    {                                                                                                                              \
        FOR_EACH(check_settable, KIND, SET)                                                                                        \
    }
#define NUMBER(VERSION, NAME, TYPE, KIND, ...)                                                                                     \
    ACCESS(VERSION, NAME, TYPE, KIND, values[index] = (TYPE)unit->values.numbers[variable];,                                       \
           unit->values.numbers[variable] = (double)values[index];, __VA_ARGS__)
#define TEXT(VERSION, ...)                                                                                                         \
    ACCESS(VERSION, String, char *, STRING, values[index] = unit->values.texts[variable - NUMBERS];,                                  \
           if (set_text(unit, variable - NUMBERS, values[index]) != OK) { return ERROR; }, __VA_ARGS__)
#define SIZE , size_t size __attribute__((unused))

NUMBER(fmi2, Real, double, FLOAT64, )
NUMBER(fmi2, Integer, int, INT32, )
NUMBER(fmi2, Boolean, int, BOOLEAN, )
NUMBER(fmi3, Float64, double, FLOAT64, SIZE)
NUMBER(fmi3, Int32, int32_t, INT32, SIZE)
NUMBER(fmi3, Boolean, bool, BOOLEAN, SIZE)
TEXT(fmi2, )
TEXT(fmi3, SIZE)

/* Functions whose only argument that matters is the instance: of both versions, and those that have nothing to do. */
#define BOTH(NAME, BODY)                                                                                                           \
    EXPORT int fmi2##NAME(struct unit *unit) { BODY }                                                                              \
    EXPORT int fmi3##NAME(struct unit *unit) { BODY }
#define NOTHING(NAME) EXPORT int NAME(struct unit *unit __attribute__((unused))) { return OK; }
#define UNSUPPORTED(NAME) EXPORT int NAME(struct unit *unit) { return report(unit, ERROR, #NAME ": not supported"); }

BOTH(ExitInitializationMode, return begin(unit);)
BOTH(Terminate, end(unit); return OK;)
BOTH(Reset, return clear(unit);)
EXPORT void fmi2FreeInstance(struct unit *unit) { drop(unit); }
EXPORT void fmi3FreeInstance(struct unit *unit) { drop(unit); }
NOTHING(fmi2SetDebugLogging) NOTHING(fmi2EnterInitializationMode) NOTHING(fmi3SetDebugLogging)
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

EXPORT int fmi2SetupExperiment(struct unit *unit, int has_tolerance, double tolerance, double start, int has_stop, double stop)
{
    (void)has_tolerance, (void)tolerance, (void)has_stop, (void)stop;
    return set_start(unit, start);
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

EXPORT int fmi3EnterInitializationMode(struct unit *unit, bool has_tolerance, double tolerance, double start, bool has_stop,
                                       double stop)
{
    (void)has_tolerance, (void)tolerance, (void)has_stop, (void)stop;
    return set_start(unit, start);
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
