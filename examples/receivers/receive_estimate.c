/* Receive the torque estimate of jtqd and react safely where there is none.
 *
 *     cc -O2 -o receive_estimate receive_estimate.c && ./receive_estimate can0
 *     ./receive_estimate can0 --joint 2 --max-age-ms 3 --stop-after-ms 20 --max-sigma-nm 2
 *     ./receive_estimate can0 --on-contact stop             with section `contact` of jtqd (docs/estimator.md)
 *
 * A bus is a SocketCAN interface, or unix:PATH, the hub of an emulated bench. Replace `react` by your controller:
 *
 *   USE   a torque may be used now: torque, sigma and age are given
 *   HOLD  none may be used, for less than --stop-after-ms: go on without torque feedback, never with the last number
 *   STOP  none for longer: bring the joint to rest. It stays until an operator starts anew (here: exit status 3)
 *
 * With --on-contact stop a contact is STOP, too, and a torque is used only while it is known that there is none.
 *
 * jtqd is not a safety function (docs/safety.md): this reaction limits damage, it replaces no emergency stop.
 * Exit status: 0 done (--seconds, Ctrl-C), 1 no such bus, 2 usage, 3 stopped.
 */
#define _GNU_SOURCE
#include "jtqd_estimate.h"

#include <errno.h>
#include <linux/can.h>
#include <linux/can/raw.h>
#include <net/if.h>
#include <poll.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/socket.h>
#include <sys/un.h>
#include <time.h>
#include <unistd.h>

#define MS 1000000LL

typedef enum { HOLD, USE, STOP } reaction;

typedef struct {
    const char *bus;
    int joint, node, overflow;
    double max_age_ms, stop_after_ms, max_sigma_nm, seconds;
    int on_contact; /* 1: stop */
} settings;

static volatile sig_atomic_t ended;

static void on_signal(int number)
{
    (void)number;
    ended = 1;
}

/* The controller: here it prints when the reaction changes, with the reason. */
static void react(reaction now, const jtqd_torque *torque, const jtqd_contact *contact)
{
    if (contact != NULL && torque->usable && now != USE)
        printf("%s  contact %s, torque rate %.0f Nm/s, age %.2f ms\n", now == STOP ? "STOP" : "HOLD",
               jtqd_contact_name(contact->code), contact->rate_nm_s, 1e-6 * (double)contact->age_ns);
    else if (now == USE)
        printf("USE   %s %.2f Nm +- %.2f, age %.2f ms\n", jtqd_status_name(torque->status), torque->torque_nm,
               torque->sigma_nm, 1e-6 * (double)torque->age_ns);
    else
        printf("%s  %s, status %s\n", now == STOP ? "STOP" : "HOLD",
               torque->usable ? "sigma too large" : jtqd_reason_name(torque->reason),
               jtqd_status_name(torque->status));
    fflush(stdout);
}

/* CLOCK_REALTIME is that of SO_TIMESTAMPNS; it may be set, so waiting times are counted by CLOCK_MONOTONIC. */
static int64_t now_ns(clockid_t clock)
{
    struct timespec now;
    clock_gettime(clock, &now);
    return now.tv_sec * 1000 * MS + now.tv_nsec;
}

static int open_bus(const settings *set)
{
    const int one = 1;
    int file;

    if (strncmp(set->bus, "unix:", 5) == 0) {
        struct sockaddr_un address = {.sun_family = AF_UNIX};
        if (strlen(set->bus + 5) >= sizeof address.sun_path)
            return -1;
        strcpy(address.sun_path, set->bus + 5);
        file = socket(AF_UNIX, SOCK_SEQPACKET | SOCK_NONBLOCK, 0);
        if (file < 0 || connect(file, (struct sockaddr *)&address, sizeof address) < 0)
            return -1;
    } else {
        const canid_t mask = CAN_SFF_MASK | CAN_EFF_FLAG | CAN_RTR_FLAG;
        const struct can_filter filters[] = {
            {JTQD_SYNC, mask},
            {0x180u + (canid_t)set->node, mask},
            {0x280u + (canid_t)set->node, mask},
            {0x380u + (canid_t)set->node, mask},
            {0x480u + (canid_t)set->node, mask},
        };
        struct sockaddr_can address = {.can_family = AF_CAN, .can_ifindex = (int)if_nametoindex(set->bus)};
        file = socket(PF_CAN, SOCK_RAW | SOCK_NONBLOCK, CAN_RAW);
        if (file < 0 || address.can_ifindex == 0 ||
            setsockopt(file, SOL_CAN_RAW, CAN_RAW_FILTER, filters, sizeof filters) < 0 ||
            bind(file, (struct sockaddr *)&address, sizeof address) < 0)
            return -1;
    }
    return setsockopt(file, SOL_SOCKET, SO_TIMESTAMPNS, &one, sizeof one) < 0 ? -1 : file;
}

/* Read one frame with the kernel's stamp: 1 a frame, 0 none is waiting, -1 the bus is gone. */
static int read_frame(int file, struct can_frame *frame, int64_t *stamp_ns)
{
    union {
        char bytes[CMSG_SPACE(sizeof(struct timespec))];
        struct cmsghdr aligned;
    } control;
    struct iovec part = {frame, sizeof *frame};
    struct msghdr message = {
        .msg_iov = &part, .msg_iovlen = 1, .msg_control = control.bytes, .msg_controllen = sizeof control};
    const ssize_t size = recvmsg(file, &message, 0);

    if (size < 0) /* an interface that is down comes back; the age tells meanwhile */
        return errno == EAGAIN || errno == EINTR || errno == ENETDOWN ? 0 : -1;
    if (size == 0)
        return -1;
    if (size != sizeof *frame || frame->can_dlc > CAN_MAX_DLEN)
        frame->can_id = CAN_ERR_FLAG; /* not for us */
    *stamp_ns = 0; /* without a stamp it is too old */
    for (struct cmsghdr *each = CMSG_FIRSTHDR(&message); each; each = CMSG_NXTHDR(&message, each))
        if (each->cmsg_level == SOL_SOCKET && each->cmsg_type == SCM_TIMESTAMPNS) {
            struct timespec stamp;
            memcpy(&stamp, CMSG_DATA(each), sizeof stamp);
            *stamp_ns = stamp.tv_sec * 1000 * MS + stamp.tv_nsec;
        }
    return 1;
}

static int control(const settings *set, int file)
{
    jtqd_receiver receiver;
    const int64_t start_ns = now_ns(CLOCK_MONOTONIC);
    int64_t used_ns = 0; /* when a torque could be used last; 0: never */
    reaction before = HOLD;
    uint64_t cycles = 0, used = 0;
    int alive = 1, first = 1;

    jtqd_begin(&receiver, (uint8_t)set->node, (uint8_t)set->overflow, (int64_t)(set->max_age_ms * MS));
    while (!ended && (set->seconds <= 0 || now_ns(CLOCK_MONOTONIC) - start_ns < (int64_t)(set->seconds * 1e3 * MS))) {
        /* One control cycle: 1 ms here, or as soon as something arrives. */
        struct pollfd waiting = {.fd = file, .events = POLLIN};
        struct can_frame frame;
        int64_t stamp_ns;
        int got = 0;

        if (alive && poll(&waiting, 1, 1) > 0)
            while ((got = read_frame(file, &frame, &stamp_ns)) > 0)
                jtqd_take(&receiver, frame.can_id, frame.data, frame.can_dlc, stamp_ns);
        if (!alive || (waiting.revents & ~POLLIN) != 0)
            nanosleep(&(struct timespec){.tv_nsec = MS}, NULL); /* down: poll returns at once */
        alive = alive && got >= 0;

        const int64_t time_ns = now_ns(CLOCK_MONOTONIC);
        const jtqd_torque torque = jtqd_read(&receiver, set->joint, now_ns(CLOCK_REALTIME));
        const jtqd_contact contact = jtqd_read_contact(&receiver, set->joint, now_ns(CLOCK_REALTIME));
        const int pushed = set->on_contact && contact.code >= JTQD_CONTACT_POSITIVE;
        const int touched = set->on_contact && contact.code != JTQD_CONTACT_NONE; /* or nobody knows */
        const int good = torque.usable && torque.sigma_nm <= set->max_sigma_nm && !touched;
        if (good)
            used_ns = time_ns;
        const reaction now = good     ? USE
                             : pushed ? STOP
                             : used_ns != 0 && time_ns - used_ns > (int64_t)(set->stop_after_ms * MS) ? STOP
                                                                                                     : HOLD;
        cycles++;
        used += (uint64_t)good;
        if (now != before || first)
            react(now, &torque, touched ? &contact : NULL);
        before = now;
        first = 0;
        if (now == STOP)
            break;
    }
    printf("received %llu, lost %llu, repeated %llu, malformed %llu; usable in %llu of %llu cycles; contact PDOs %llu\n",
           (unsigned long long)receiver.received, (unsigned long long)receiver.lost,
           (unsigned long long)receiver.repeated, (unsigned long long)receiver.malformed, (unsigned long long)used,
           (unsigned long long)cycles, (unsigned long long)receiver.contacts);
    return before == STOP ? 3 : 0;
}

static int usage(void)
{
    fprintf(stderr, "usage: receive_estimate INTERFACE|unix:PATH [--joint 1..4] [--node N] [--overflow N]\n"
                    "       [--max-age-ms MS] [--stop-after-ms MS] [--max-sigma-nm NM] [--seconds S]\n"
                    "       [--on-contact stop|ignore]\n");
    return 2;
}

int main(int count, char **arguments)
{
    settings set = {.joint = 1, .node = 0x20, .overflow = 240, .max_age_ms = 5, .stop_after_ms = 50, .max_sigma_nm = 5};

    if (count < 2 || arguments[1][0] == '-' || count % 2 != 0)
        return usage();
    set.bus = arguments[1];
    for (int at = 2; at < count; at += 2) {
        const char *name = arguments[at];
        char *rest;
        const double value = strtod(arguments[at + 1], &rest);

        if (strcmp(name, "--on-contact") == 0) {
            set.on_contact = strcmp(arguments[at + 1], "stop") == 0;
            if (!set.on_contact && strcmp(arguments[at + 1], "ignore") != 0)
                return usage();
            continue;
        }
        if (*rest != '\0' || !(value > 0))
            return usage();
        if (strcmp(name, "--joint") == 0 && value <= JTQD_JOINTS)
            set.joint = (int)value;
        else if (strcmp(name, "--node") == 0 && value <= 127)
            set.node = (int)value;
        else if (strcmp(name, "--overflow") == 0 && value >= 2 && value <= 240)
            set.overflow = (int)value;
        else if (strcmp(name, "--max-age-ms") == 0)
            set.max_age_ms = value;
        else if (strcmp(name, "--stop-after-ms") == 0)
            set.stop_after_ms = value;
        else if (strcmp(name, "--max-sigma-nm") == 0)
            set.max_sigma_nm = value;
        else if (strcmp(name, "--seconds") == 0)
            set.seconds = value;
        else
            return usage();
    }
    const int file = open_bus(&set);
    if (file < 0) {
        fprintf(stderr, "receive_estimate: %s: %s\n", set.bus, errno ? strerror(errno) : "no such bus");
        return 1;
    }
    signal(SIGINT, on_signal);
    signal(SIGTERM, on_signal);
    const int status = control(&set, file);
    close(file);
    return status;
}
