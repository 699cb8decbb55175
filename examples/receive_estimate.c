/* Receive the torque estimate of jtqd on SocketCAN and print it (docs/bus.md: estimate PDO of node 20h).
 *
 *     cc -O2 -o receive_estimate receive_estimate.c && ./receive_estimate can0
 *
 * "-" instead of an interface reads struct can_frame from standard input. A controller that acts on the torque must
 * read docs/safety.md first: check status and sequence of every PDO, and time out without one.
 */
#include <linux/can.h>
#include <linux/can/raw.h>
#include <net/if.h>
#include <stdint.h>
#include <stdio.h>
#include <string.h>
#include <sys/socket.h>
#include <unistd.h>

#define COB_ID 0x1A0
#define NO_TORQUE (-0x8000)
#define UNKNOWN_SIGMA 255

static const char *const STATUS[16] = {
    [0] = "off", [1] = "starting", [2] = "valid", [3] = "degraded", [4] = "stale",
    [5] = "drive_fault", [6] = "standstill", [15] = "invalid",
};

static void print_joint(int number, const uint8_t torque[2], uint8_t sigma, uint8_t status)
{
    int16_t counts = (int16_t)(torque[0] | torque[1] << 8); /* little endian, 0.01 Nm */
    const char *name = STATUS[status] ? STATUS[status] : "unknown";

    if (counts == NO_TORQUE)
        printf("  %d: no torque, %s", number, name);
    else if (sigma == UNKNOWN_SIGMA)
        printf("  %d: %.2f Nm +- ?, %s", number, 0.01 * counts, name);
    else
        printf("  %d: %.2f Nm +- %.2f, %s", number, 0.01 * counts, 0.05 * sigma, name);
}

static int open_can(const char *name)
{
    struct sockaddr_can address = {.can_family = AF_CAN, .can_ifindex = (int)if_nametoindex(name)};
    struct can_filter filter = {.can_id = COB_ID, .can_mask = CAN_SFF_MASK | CAN_EFF_FLAG | CAN_RTR_FLAG};
    int file = socket(PF_CAN, SOCK_RAW, CAN_RAW);

    if (file < 0 || address.can_ifindex == 0 ||
        setsockopt(file, SOL_CAN_RAW, CAN_RAW_FILTER, &filter, sizeof filter) < 0 ||
        bind(file, (struct sockaddr *)&address, sizeof address) < 0)
        return -1;
    return file;
}

int main(int count, char **arguments)
{
    struct can_frame frame;
    int file = count == 2 ? (strcmp(arguments[1], "-") ? open_can(arguments[1]) : STDIN_FILENO) : -1;

    if (file < 0) {
        fprintf(stderr, "usage: receive_estimate INTERFACE (found no such CAN interface)\n");
        return 2;
    }
    while (read(file, &frame, sizeof frame) == sizeof frame) {
        if (frame.can_id != COB_ID || frame.can_dlc != 8)
            continue;
        printf("%3u", frame.data[7]);
        print_joint(1, frame.data, frame.data[4], frame.data[6] & 0x0F);
        print_joint(2, frame.data + 2, frame.data[5], frame.data[6] >> 4);
        puts("");
        fflush(stdout);
    }
    return 0;
}
