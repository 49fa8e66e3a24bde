// Whether helpers pay. Beside busy processes the scheduler puts threads aside in the middle of their work, and the
// others wait for them: one thread alone, which gets a larger share of its core, may then do more.
#pragma once

#include <time.h>

#include <chrono>

namespace splatam {

using Nanoseconds = std::chrono::nanoseconds;

// Returns for how long the calling thread has had a core.
inline Nanoseconds time_on_core() {
  timespec now{};
  clock_gettime(CLOCK_THREAD_CPUTIME_ID, &now);
  return std::chrono::seconds(now.tv_sec) + Nanoseconds(now.tv_nsec);
}

// Chooses between working with helpers and alone, by how much gets done. As long as helpers bring more than one thread
// could do at best, as on idle cores, working alone is not tried.
class Crew {
 public:
  bool has_helpers() const { return has_helpers_; }

  // Tells of a job: how long it took, and for how long its pieces were worked on, by all threads together.
  void note(Nanoseconds took, Nanoseconds worked) {
    took_ += took, worked_ += worked;
    if (took_ < kPeriod) return;
    const double speed = double(worked_.count()) / double(took_.count());
    speeds_[has_helpers_] = speed;
    took_ = worked_ = Nanoseconds(0);
    if (periods_left_ > 0 && --periods_left_ > 0) return;
    if (!is_trial_) {
      is_trial_ = !(has_helpers_ && speed > kBestAlone);
      has_helpers_ ^= is_trial_;
      return;
    }
    is_trial_ = false;
    has_helpers_ = speeds_[true] >= speeds_[false];
    periods_left_ = kPeriods;
  }

 private:
  static constexpr Nanoseconds kPeriod = std::chrono::milliseconds(100);  // of jobs: many times the scheduler's slices
  static constexpr int kPeriods = 8;  // until the other way is tried again, for one period
  static constexpr double kBestAlone = 0.9;

  bool has_helpers_ = true, is_trial_ = false;
  int periods_left_ = 0;
  double speeds_[2] = {};  // without helpers, with helpers
  Nanoseconds took_{0}, worked_{0};
};

}  // namespace splatam
