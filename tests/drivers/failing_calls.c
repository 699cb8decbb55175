/* Preloaded: send and recvmmsg fail with the error whose number stands in the environment variable of their name. */

#include <errno.h>
#include <stdlib.h>
#include <sys/socket.h>
#include <sys/syscall.h>
#include <time.h>
#include <unistd.h>

static int fails(const char *call)
{
    const char *number = getenv(call);
    if (number)
        errno = atoi(number);
    return number != NULL;
}

ssize_t send(int fd, const void *message, size_t size, int flags)
{
    return fails("send") ? -1 : sendto(fd, message, size, flags, NULL, 0);
}

int recvmmsg(int fd, struct mmsghdr *messages, unsigned int count, int flags, struct timespec *timeout)
{
    return fails("recvmmsg") ? -1 : (int)syscall(SYS_recvmmsg, fd, messages, count, flags, timeout);
}
