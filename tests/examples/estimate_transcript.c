/* Drives jtqd_estimate.h from a transcript on stdin; compiled as C99 and, through jtqd_estimate.hpp, as C++17.
 *
 *     begin OVERFLOW MAX_AGE_NS     take ID STAMP_NS LENGTH HEX     read JOINT NOW_NS     touched JOINT NOW_NS     counters
 */
#include <stdio.h>
#ifdef __cplusplus
#include "jtqd_estimate.hpp"
#else
#include "jtqd_estimate.h"
#endif

int main(void)
{
    char word[32];
    jtqd_receiver receiver;
#ifdef __cplusplus
    jtqd::Receiver twin;
#endif

    jtqd_begin(&receiver, 0x20, 240, 5000000);
    while (scanf("%31s", word) == 1) {
        if (strcmp(word, "begin") == 0) {
            unsigned overflow;
            long long age;
            if (scanf("%u %lld", &overflow, &age) != 2)
                return 1;
            jtqd_begin(&receiver, 0x20, (uint8_t)overflow, age);
#ifdef __cplusplus
            twin = jtqd::Receiver({0x20, (uint8_t)overflow, jtqd::Nanoseconds(age)});
#endif
        } else if (strcmp(word, "take") == 0) {
            unsigned id, length, byte;
            long long stamp;
            uint8_t data[8] = {0};
            if (scanf("%x %lld %u", &id, &stamp, &length) != 3 || length > 8)
                return 1;
            for (unsigned at = 0; at < length; at++) {
                if (scanf("%2x", &byte) != 1)
                    return 1;
                data[at] = (uint8_t)byte;
            }
            printf("%d\n", jtqd_take(&receiver, id, data, length, stamp));
#ifdef __cplusplus
            const bool estimate = id == 0x1A0 || id == 0x2A0;
            if (twin.take(id, data, length, jtqd::Nanoseconds(stamp)) && !estimate)
                return 1;
#endif
        } else if (strcmp(word, "read") == 0) {
            int joint;
            long long now;
            if (scanf("%d %lld", &joint, &now) != 2)
                return 1;
            const jtqd_torque found = jtqd_read(&receiver, joint, now);
            printf("%s %s %.4f %.4f %lld\n", found.usable ? "usable" : "none", jtqd_status_name(found.status),
                   found.torque_nm, found.sigma_nm, (long long)found.age_ns);
            if (!found.usable)
                printf("  %s\n", jtqd_reason_name(found.reason));
#ifdef __cplusplus
            if (twin.torque(joint, jtqd::Nanoseconds(now)).has_value() != found.usable)
                return 1;
            if (found.usable && twin.torque(joint, jtqd::Nanoseconds(now))->nm != found.torque_nm)
                return 1;
#endif
        } else if (strcmp(word, "touched") == 0) {
            int joint;
            long long now;
            if (scanf("%d %lld", &joint, &now) != 2)
                return 1;
            const jtqd_contact found = jtqd_read_contact(&receiver, joint, now);
            printf("%s %.0f %lld\n", jtqd_contact_name(found.code), found.rate_nm_s, (long long)found.age_ns);
#ifdef __cplusplus
            const auto told = twin.contact(joint, jtqd::Nanoseconds(now));
            if (told.has_value() != (found.code >= JTQD_CONTACT_NONE))
                return 1;
            if (told && (told->there != (found.code > JTQD_CONTACT_NONE) ||
                         told->positive != (found.code == JTQD_CONTACT_POSITIVE)))
                return 1;
#endif
        } else if (strcmp(word, "counters") == 0)
            printf("received %llu lost %llu repeated %llu malformed %llu\n", (unsigned long long)receiver.received,
                   (unsigned long long)receiver.lost, (unsigned long long)receiver.repeated,
                   (unsigned long long)receiver.malformed);
        else
            return 1;
    }
    return 0;
}
