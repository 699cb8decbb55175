// Estimate of jtqd for a controller in C++17: jtqd_estimate.h (what is checked stands there) as a class.
//
//     jtqd::Receiver receiver;                                                  // node 20h, at most 5 ms old
//     receiver.take(frame.can_id, frame.data, frame.can_dlc, stamp);            // every frame, with its time stamp
//     if (auto torque = receiver.torque(1, now)) use(torque->nm, torque->sigma_nm);
//     else hold(receiver.reason(1, now));
//     if (auto contact = receiver.contact(1, now); !contact) hold("contact not known");      // with section `contact`
//     else if (contact->there) stop();
#pragma once

#include <chrono>
#include <cstddef>
#include <cstdint>
#include <optional>
#include <string>

#include "jtqd_estimate.h"

namespace jtqd {

using Nanoseconds = std::chrono::nanoseconds;

struct Settings {
    std::uint8_t node = 0x20;
    std::uint8_t overflow = 240;  // `sync.counter_overflow` of jtqd's configuration
    Nanoseconds max_age = std::chrono::milliseconds(5);
};

struct Torque {
    double nm;
    double sigma_nm;  // infinite: unknown
    std::uint8_t status;  // JTQD_VALID, JTQD_DEGRADED or JTQD_STANDSTILL (an interval: sigma is its half width)
    Nanoseconds age;
};

struct Contact {
    bool there;
    bool positive;      // of one that is there: pushed along the joint's positive direction
    double rate_nm_s;   // of the torque; NaN where it is not known
    Nanoseconds age;
};

class Receiver {
public:
    explicit Receiver(const Settings &settings = Settings{})
    {
        jtqd_begin(&state_, settings.node, settings.overflow, settings.max_age.count());
    }

    // Take any frame, with its stamp since the epoch of the clock that `torque` is asked with; true for a new estimate.
    bool take(std::uint32_t can_id, const std::uint8_t *data, std::size_t length, Nanoseconds stamp)
    {
        const int taken = jtqd_take(&state_, can_id, data, length, stamp.count());
        return taken >= 1 && taken <= JTQD_PDOS;
    }

    // What may be used of joint 1..4 now; nothing where `reason` says why.
    std::optional<Torque> torque(int joint, Nanoseconds now) const
    {
        const jtqd_torque found = jtqd_read(&state_, joint, now.count());
        if (!found.usable)
            return std::nullopt;
        return Torque{found.torque_nm, found.sigma_nm, found.status, Nanoseconds(found.age_ns)};
    }

    // Whether joint 1..4 is pushed from outside; nothing where that is not known or not watched.
    std::optional<Contact> contact(int joint, Nanoseconds now) const
    {
        const jtqd_contact found = jtqd_read_contact(&state_, joint, now.count());
        if (found.code < JTQD_CONTACT_NONE)
            return std::nullopt;
        return Contact{found.code != JTQD_CONTACT_NONE, found.code == JTQD_CONTACT_POSITIVE, found.rate_nm_s,
                       Nanoseconds(found.age_ns)};
    }

    // Why there is no torque, with the status that jtqd told last.
    std::string reason(int joint, Nanoseconds now) const
    {
        const jtqd_torque found = jtqd_read(&state_, joint, now.count());
        return std::string(jtqd_reason_name(found.reason)) + ", status " + jtqd_status_name(found.status);
    }

    std::uint64_t received() const { return state_.received; }
    std::uint64_t lost() const { return state_.lost; }

private:
    jtqd_receiver state_;
};

}  // namespace jtqd
