/* Contender: the loop of jtqd as one would write it in C. Same frames, arithmetic, estimate PDO and cycle record.

   loop run BUS CPU PRIORITY RING    one round per line "run CYCLES" on standard input, one JSON line per round on standard output
   loop awake CPU                    keeps a CPU from going idle, in whose time nobody else wants it: see host.py
   loop replay IN OUT                cycles from a file (SYNC stamp i64, then five frames of 16 bytes), eight bytes of estimate PDO each

   parameters.h is written by c_program.py from the same configuration and networks that the Python contenders read. */
#define _GNU_SOURCE
#include <errno.h>
#include <fcntl.h>
#include <poll.h>
#include <sched.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/mman.h>
#include <sys/prctl.h>
#include <sys/resource.h>
#include <sys/socket.h>
#include <sys/un.h>
#include <time.h>
#include <unistd.h>

#include "estimator.h"
#include "parameters.h"

enum { PDOS = 5, CAPACITY = 32, NS = 1000000000, PERIOD = 1000000, HEARTBEAT_EVERY = 100, STARTING_CYCLES = 20 };
enum { RING_HEADER = 4096, RING_COUNT_OFFSET = 64 }; /* as daemon/ring.py; nobody reads this ring */
enum { FLAG_COMPLETE = 1, FLAG_PUBLISHED = 2, FLAG_BEFORE_NEXT_SYNC = 4, FLAG_SYNC_CONFIRMED = 8 };

typedef struct {
    uint32_t id;
    uint8_t length, pad[3], data[8];
} frame;

typedef struct __attribute__((packed)) {
    double current, motor_position, motor_velocity, link_position, sensor, temperature, torque, sigma, tob, efficiency, network, dt, reference, age, torque_rate, contact;
    uint16_t statusword, status, sensor_status, flags;
} joint_record;

typedef struct __attribute__((packed)) {
    uint64_t index;
    int64_t sync_monotonic, sync_realtime;
    uint32_t flags, work;
    int32_t late;
    uint32_t missed;
    uint8_t counter, frame_count, left_out, stale, late_frames, duplicates, rejected, spare;
    joint_record joints[2];
    frame frames[FRAME_CAPACITY];
    int64_t stamps[FRAME_CAPACITY];
    uint64_t tail;
} cycle_record;

_Static_assert(sizeof(cycle_record) == RECORD_SIZE, "daemon/cycle_record.py has another layout");

/* In the order of the identifiers in traffic.py: drive 1 and 2 TPDO1, sensor, drive 1 and 2 TPDO2. */
static const struct { uint32_t id; uint8_t length; } expected[PDOS] = {
    {0x181, 8}, {0x182, 8}, {0x183, 5}, {0x281, 8}, {0x282, 8}};

typedef struct {
    bool fresh;
    int64_t stamp;
    uint8_t data[8];
} input;

typedef struct {
    double since, last, z, settled;
} sensor_filter;

typedef struct {
    int fd;
    uint8_t *ring;
    uint64_t ring_count, index, published, missed;
    uint8_t counter;
    input inputs[PDOS];
    int64_t sync_stamp, last_sync;
    uint32_t late, duplicates, rejected, stale;
    joint_state joints[2];
    sensor_filter references[2];
    int held[2], calm[2], asked[2];
    struct mmsghdr messages[CAPACITY];
    struct iovec parts[CAPACITY];
    frame frames[CAPACITY];
    char control[CAPACITY][64];
    int64_t wait; /* from SYNC to the wake-up for the inputs */
    bool follows; /* the wake-up follows the arrivals, as jtqd's does */
} loop_state;

static int64_t now(clockid_t clock)
{
    struct timespec t;
    clock_gettime(clock, &t);
    return (int64_t)t.tv_sec * NS + t.tv_nsec;
}

static void sleep_until(int64_t when)
{
    struct timespec t = {when / NS, when % NS};
    while (clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &t, NULL) == EINTR)
        ;
}

static int32_t i32(const uint8_t *p) { int32_t v; memcpy(&v, p, 4); return v; }
static int16_t i16(const uint8_t *p) { int16_t v; memcpy(&v, p, 2); return v; }
static uint16_t u16(const uint8_t *p) { uint16_t v; memcpy(&v, p, 2); return v; }

/* Sort one frame in; an input counts once per cycle and only after the SYNC's own echo. */
static void take(loop_state *s, const frame *f, int64_t stamp, bool draining)
{
    if (f->id == 0x080) {
        if (f->pad[0] & 1)
            s->sync_stamp = stamp;
        return;
    }
    for (int n = 0; n < PDOS; n++) {
        if (f->id != expected[n].id)
            continue;
        input *in = &s->inputs[n];
        if (f->length != expected[n].length)
            s->rejected++;
        else if (draining || stamp < s->sync_stamp)
            s->late++;
        else if (in->fresh)
            s->duplicates++;
        else {
            in->fresh = true;
            in->stamp = stamp;
            memcpy(in->data, f->data, 8);
        }
        return;
    }
}

static bool complete(const loop_state *s)
{
    for (int n = 0; n < PDOS; n++)
        if (!s->inputs[n].fresh)
            return false;
    return true;
}

/* When the last input came, CLOCK_REALTIME. */
static int64_t last_stamp(const loop_state *s)
{
    int64_t last = 0;
    for (int n = 0; n < PDOS; n++)
        if (s->inputs[n].stamp > last)
            last = s->inputs[n].stamp;
    return last;
}

/* daemon/core/schedule.pyx, WakeUp: wake up when 99 of 100 times all inputs have come. */
static void follow(loop_state *s, int64_t delay)
{
    if (delay + FOLLOW_MARGIN_NS > s->wait)
        s->wait = s->wait + 99 * FOLLOW_STEP_NS < DEADLINE_NS - FOLLOW_MARGIN_NS ? s->wait + 99 * FOLLOW_STEP_NS
                                                                                : DEADLINE_NS - FOLLOW_MARGIN_NS;
    else
        s->wait = s->wait - FOLLOW_STEP_NS > FOLLOW_SHORTEST_NS ? s->wait - FOLLOW_STEP_NS : FOLLOW_SHORTEST_NS;
}

static int64_t stamp_of(struct msghdr *m)
{
    for (struct cmsghdr *c = CMSG_FIRSTHDR(m); c; c = CMSG_NXTHDR(m, c))
        if (c->cmsg_level == SOL_SOCKET && c->cmsg_type == SO_TIMESTAMPNS) {
            struct timespec t;
            memcpy(&t, CMSG_DATA(c), sizeof t);
            return (int64_t)t.tv_sec * NS + t.tv_nsec;
        }
    return 0;
}

static void receive(loop_state *s, cycle_record *r, bool draining)
{
    for (int n = 0; n < CAPACITY; n++)
        s->messages[n].msg_hdr.msg_controllen = sizeof s->control[n];
    int count = recvmmsg(s->fd, s->messages, CAPACITY, MSG_DONTWAIT, NULL);
    for (int n = 0; n < count; n++) {
        if (s->messages[n].msg_len != sizeof(frame))
            continue;
        int64_t stamp = stamp_of(&s->messages[n].msg_hdr);
        take(s, &s->frames[n], stamp, draining);
        if (r->frame_count < FRAME_CAPACITY) {
            r->frames[r->frame_count] = s->frames[n];
            memset(r->frames[r->frame_count].pad, 0, 3);
            r->stamps[r->frame_count++] = stamp;
        } else
            r->left_out++;
    }
}

/* daemon/estimate_pdo.py: torque in 0.01 Nm, sigma in 0.05 Nm rounded up, 8000h and 255 where there is no number. */
static void field(double torque, double sigma, int *status, int16_t *torque_field, uint8_t *sigma_field)
{
    double counts = torque * 100.0;
    bool known = *status == VALID || *status == DEGRADED || *status == STANDSTILL;
    *torque_field = INT16_MIN;
    *sigma_field = 255;
    if (!known)
        return;
    if (!(counts >= -32767.0 && counts <= 32767.0 && sigma >= 0.0 && sigma < INFINITY)) {
        *status = INVALID;
        return;
    }
    if (sigma <= 12.7)
        *sigma_field = (uint8_t)ceil(sigma * 20.0 - 1e-9);
    *torque_field = (int16_t)nearbyint(counts);
}

/* daemon/joint_status.py for the statuses of this traffic, which has no faults and loses nothing. */
static int hold(loop_state *s, int n, int status)
{
    static const int rank[16] = {[VALID] = 0, [STANDSTILL] = 1, [DEGRADED] = 2, [STARTING] = 3};
    int held = s->held[n] ? s->held[n] : STARTING;
    if (rank[status] >= rank[held] || rank[held] <= 1) {
        s->calm[n] = 0;
        return s->held[n] = status;
    }
    if (!s->calm[n] || rank[status] > rank[s->asked[n]])
        s->asked[n] = status;
    if (++s->calm[n] < (held == DEGRADED ? DEGRADED_CYCLES : 1))
        return status == STANDSTILL && held == DEGRADED ? STANDSTILL : held;
    s->calm[n] = 0;
    return s->held[n] = s->asked[n];
}

/* observer.pyx, follow_reference: the sensor as old as the estimate; NAN until it has settled. */
static double follow_sensor(sensor_filter *f, double rate, double dt, double sensor)
{
    f->since = dt > 0.0 ? f->since + dt : INFINITY;
    if (isnan(sensor))
        return NAN;
    if (f->since <= MAX_GAP_S) {
        double x = rate * f->since, gone = -expm1(-x), share = gone / x, a = 1.0 - gone;
        f->z = a * f->z + (1.0 - share) * sensor + (share - a) * f->last;
        f->settled += f->since;
    } else
        f->z = sensor, f->settled = 0.0;
    f->last = sensor, f->since = 0.0;
    return f->settled * rate >= 5.0 ? f->z : NAN;
}

/* Both joints from the inputs of this cycle; fills the record and the eight bytes of the estimate PDO. */
static void observe(loop_state *s, int64_t sync, cycle_record *r, uint8_t pdo[8])
{
    int16_t torque[2];
    uint8_t sigma[2];
    int status[2];
    const input *sensor = &s->inputs[2];
    for (int n = 0; n < 2; n++) {
        const input *position = &s->inputs[n], *motion = &s->inputs[3 + n];
        joint_record *j = &r->joints[n];
        estimate e = nothing(STALE);
        j->sensor = sensor->fresh && !(sensor->data[4] & 7) ? i32(sensor->data) * NM_PER_UNIT : NAN;
        j->reference = NAN, j->age = 1e3 / parameters[n].rate;
        j->torque_rate = j->contact = NAN;
        j->temperature = NAN; /* the traffic has none */
        j->sensor_status = sensor->fresh ? sensor->data[4] : 0;
        j->flags = position->fresh | motion->fresh << 1 | sensor->fresh << 2;
        if (position->fresh && motion->fresh) {
            j->motor_position = i32(position->data) * MOTOR_RAD_PER_COUNT;
            j->link_position = i32(position->data + 4) * LINK_RAD_PER_COUNT;
            j->motor_velocity = i32(motion->data) * MOTOR_RAD_S_PER_UNIT;
            j->current = i16(motion->data + 4) * AMPERE_PER_UNIT;
            j->statusword = u16(motion->data + 6);
            int64_t dt = s->last_sync ? sync - s->last_sync : 0;
            if (dt - PERIOD > -STAMP_ACCURACY_NS && dt - PERIOD < STAMP_ACCURACY_NS)
                dt = PERIOD;
            j->dt = dt * 1e-9;
            e = step(&parameters[n], &s->joints[n], j->dt, j->current, j->motor_position, j->motor_velocity, j->link_position);
            j->reference = follow_sensor(&s->references[n], parameters[n].rate, j->dt, j->sensor);
            bool known = e.status == VALID || e.status == DEGRADED || e.status == STANDSTILL;
            if (s->index < STARTING_CYCLES && known)
                e.status = STARTING;
            if ((j->statusword & 0x6F) != 0x27 && (j->statusword & 0x6F) != 0x07)
                e.status = (j->statusword & 0x4F) == 0x0F || (j->statusword & 0x4F) == 0x08 ? DRIVE_FAULT : OFF;
        }
        e.status = hold(s, n, e.status);
        j->torque = e.torque, j->sigma = e.sigma, j->tob = e.tob, j->efficiency = e.efficiency, j->network = e.network;
        j->status = (uint16_t)e.status;
        status[n] = e.status;
        field(e.torque, e.sigma, &status[n], &torque[n], &sigma[n]);
    }
    s->last_sync = sync;
    memcpy(pdo, &torque[0], 2), memcpy(pdo + 2, &torque[1], 2);
    pdo[4] = sigma[0], pdo[5] = sigma[1], pdo[6] = (uint8_t)(status[0] | status[1] << 4), pdo[7] = s->counter;
    s->published += torque[0] != INT16_MIN && torque[1] != INT16_MIN;
}

static void transmit(loop_state *s, uint32_t id, uint8_t length, const uint8_t *data, frame *copy)
{
    frame f = {.id = id, .length = length};
    memcpy(f.data, data, length);
    if (copy)
        *copy = f;
    f.pad[0] = id == 0x080; /* drivers/frame.py: bit 0 of byte 5 asks the hub for the echo */
    if (send(s->fd, &f, sizeof f, MSG_DONTWAIT) != sizeof f)
        perror("send");
}

static void cycle(loop_state *s, int64_t slot, int64_t *answer, int64_t *after)
{
    cycle_record *r = (cycle_record *)(s->ring + RING_HEADER + (s->ring_count % RING_SLOTS) * RECORD_SIZE);
    r->frame_count = r->left_out = 0;
    uint32_t late = s->late, duplicates = s->duplicates, rejected = s->rejected, stale = s->stale;
    receive(s, r, true);
    for (int n = 0; n < PDOS; n++)
        s->inputs[n].fresh = false;
    s->sync_stamp = 0;
    s->counter = s->counter % 240 + 1;
    int64_t sync = now(CLOCK_MONOTONIC), offset = now(CLOCK_REALTIME) - sync;
    transmit(s, 0x080, 1, &s->counter, NULL);
    sleep_until(sync + s->wait);
    int64_t woken = now(CLOCK_MONOTONIC), deadline = sync + DEADLINE_NS;
    for (;;) {
        receive(s, r, false);
        int64_t left = deadline - now(CLOCK_MONOTONIC);
        if (complete(s) || left <= 0)
            break;
        struct pollfd p = {s->fd, POLLIN, 0};
        struct timespec t = {0, left};
        if (ppoll(&p, 1, &t, NULL) <= 0)
            break;
    }
    r->flags = (complete(s) ? FLAG_COMPLETE : 0) | (s->sync_stamp ? FLAG_SYNC_CONFIRMED : 0);
    for (int n = 0; n < PDOS; n++)
        s->stale += !s->inputs[n].fresh;
    int64_t realtime = s->sync_stamp ? s->sync_stamp : sync + offset;
    uint8_t pdo[8];
    observe(s, realtime - offset, r, pdo);
    frame sent;
    transmit(s, 0x1A0, 8, pdo, &sent);
    *answer = now(CLOCK_MONOTONIC) - sync;
    *after = complete(s) ? sync + offset + *answer - last_stamp(s) : -1;
    if (s->follows && complete(s) && s->sync_stamp)
        follow(s, last_stamp(s) - s->sync_stamp);
    r->flags |= FLAG_PUBLISHED | (now(CLOCK_MONOTONIC) < slot + PERIOD ? FLAG_BEFORE_NEXT_SYNC : 0);
    if (r->frame_count < FRAME_CAPACITY) {
        r->frames[r->frame_count] = sent;
        r->stamps[r->frame_count++] = now(CLOCK_MONOTONIC) + offset;
    }
    if (s->index % HEARTBEAT_EVERY == 0)
        transmit(s, 0x720, 1, (const uint8_t[]){5}, NULL);
    r->index = s->index;
    r->sync_monotonic = sync, r->sync_realtime = realtime;
    r->work = (uint32_t)(now(CLOCK_MONOTONIC) - woken);
    r->late = (int32_t)(sync - slot);
    r->missed = (uint32_t)s->missed;
    r->counter = s->counter;
    r->stale = (uint8_t)(s->stale - stale), r->late_frames = (uint8_t)(s->late - late);
    r->duplicates = (uint8_t)(s->duplicates - duplicates), r->rejected = (uint8_t)(s->rejected - rejected);
    r->tail = s->index;
    s->ring_count++;
    __atomic_store_n((uint64_t *)(s->ring + RING_COUNT_OFFSET), s->ring_count, __ATOMIC_RELEASE);
    s->index++;
}

static int open_bus(const char *path)
{
    struct sockaddr_un address = {.sun_family = AF_UNIX};
    strncpy(address.sun_path, path, sizeof address.sun_path - 1);
    int fd = socket(AF_UNIX, SOCK_SEQPACKET, 0), on = 1, size = 1 << 20;
    setsockopt(fd, SOL_SOCKET, SO_TIMESTAMPNS, &on, sizeof on);
    setsockopt(fd, SOL_SOCKET, SO_SNDBUF, &size, sizeof size);
    if (fd < 0 || connect(fd, (struct sockaddr *)&address, sizeof address)) {
        perror(path);
        exit(1);
    }
    return fd;
}

static uint8_t *open_ring(const char *path)
{
    int fd = open(path, O_RDWR | O_CREAT | O_TRUNC, 0600);
    size_t size = RING_HEADER + (size_t)RING_SLOTS * RECORD_SIZE;
    if (fd < 0 || ftruncate(fd, (off_t)size)) {
        perror(path);
        exit(1);
    }
    uint8_t *memory = mmap(NULL, size, PROT_READ | PROT_WRITE, MAP_SHARED, fd, 0);
    close(fd);
    return memory;
}

static void prepare_messages(loop_state *s)
{
    for (int n = 0; n < CAPACITY; n++) {
        s->parts[n] = (struct iovec){&s->frames[n], sizeof(frame)};
        s->messages[n].msg_hdr = (struct msghdr){.msg_iov = &s->parts[n], .msg_iovlen = 1, .msg_control = s->control[n]};
    }
}

static void print_list(const char *name, const int64_t *values, long count)
{
    printf("\"%s\": [", name);
    for (long n = 0; n < count; n++)
        printf(n ? ", %lld" : "%lld", (long long)values[n]);
    printf("], ");
}

static void run_round(const char *bus, const char *ring, long cycles, bool follows)
{
    static loop_state s;
    int64_t *cpu = calloc((size_t)cycles, sizeof *cpu), *answer = calloc((size_t)cycles, sizeof *answer);
    int64_t *after = calloc((size_t)cycles, sizeof *after);
    memset(&s, 0, sizeof s);
    s.wait = WAIT_NS;
    s.follows = follows;
    s.fd = open_bus(bus);
    s.ring = open_ring(ring);
    prepare_messages(&s);
    struct rusage begun, ended;
    getrusage(RUSAGE_SELF, &begun);
    long done = 0;
    int64_t slot = now(CLOCK_MONOTONIC) + 2 * PERIOD, end = slot + cycles * PERIOD;
    while (slot < end) {
        sleep_until(slot);
        int64_t late = now(CLOCK_MONOTONIC) - slot;
        if (late > PERIOD / 2)
            s.missed++;
        else {
            cycle(&s, slot, &answer[done], &after[done]);
            cpu[done++] = now(CLOCK_PROCESS_CPUTIME_ID);
        }
        slot += PERIOD;
        late = now(CLOCK_MONOTONIC) - slot;
        if (late > PERIOD / 2) {
            int64_t skipped = (late + PERIOD / 2) / PERIOD;
            slot += skipped * PERIOD;
            s.missed += (uint64_t)skipped;
        }
    }
    getrusage(RUSAGE_SELF, &ended);
    close(s.fd);
    munmap(s.ring, RING_HEADER + (size_t)RING_SLOTS * RECORD_SIZE);
    printf("{");
    print_list("cpu_ns", cpu, done);
    print_list("answer_ns", answer, done);
    print_list("after_last_ns", after, done);
    printf("\"published\": %llu, \"missed\": %llu, \"switches\": %ld}\n", (unsigned long long)s.published,
           (unsigned long long)s.missed, ended.ru_nvcsw - begun.ru_nvcsw);
    fflush(stdout);
    free(cpu);
    free(answer);
    free(after);
}

static int replay(const char *in, const char *out)
{
    static loop_state s;
    FILE *source = fopen(in, "rb"), *sink = fopen(out, "wb");
    struct { int64_t sync; frame frames[PDOS]; } one;
    while (source && sink && fread(&one, sizeof one, 1, source) == 1) {
        cycle_record r = {0};
        uint8_t pdo[8];
        s.sync_stamp = one.sync;
        s.counter = s.counter % 240 + 1;
        for (int n = 0; n < PDOS; n++) {
            s.inputs[n].fresh = false;
            take(&s, &one.frames[n], one.sync + 1, false);
        }
        observe(&s, one.sync, &r, pdo);
        s.index++;
        fwrite(pdo, sizeof pdo, 1, sink);
    }
    return source && sink && fclose(sink) == 0 ? 0 : 1;
}

static void stay_on(int cpu)
{
    if (cpu >= 0) {
        cpu_set_t set;
        CPU_ZERO(&set);
        CPU_SET(cpu, &set);
        sched_setaffinity(0, sizeof set, &set);
    }
}

static void keep_awake(int cpu)
{
    struct sched_param none = {0};
    stay_on(cpu);
    if (sched_setscheduler(0, SCHED_IDLE, &none))
        exit(1);
    puts("ready");
    fflush(stdout);
    while (getppid() != 1) /* the parent ends it by SIGKILL; without a parent it ends itself */
        for (volatile int n = 0; n < 1000000; n++)
            ;
    exit(0);
}

int main(int argc, char **argv)
{
    if (argc == 3 && !strcmp(argv[1], "awake"))
        keep_awake(atoi(argv[2]));
    if (argc == 4 && !strcmp(argv[1], "replay"))
        return replay(argv[2], argv[3]);
    if ((argc != 6 && argc != 7) || strcmp(argv[1], "run"))
        return 2;
    prctl(PR_SET_TIMERSLACK, 1UL, 0, 0, 0);
    mlockall(MCL_CURRENT | MCL_FUTURE | MCL_ONFAULT);
    struct sched_param priority = {atoi(argv[4])};
    stay_on(atoi(argv[3]));
    sched_setscheduler(0, SCHED_FIFO, &priority);
    puts("ready");
    fflush(stdout);
    long cycles;
    while (scanf(" run %ld", &cycles) == 1)
        run_round(argv[2], argv[5], cycles, argc == 7 && !strcmp(argv[6], "follow"));
    return 0;
}
