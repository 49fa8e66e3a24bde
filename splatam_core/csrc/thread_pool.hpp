// The threads of the native code: one pool for everything in the process. run(threads, pieces, task) calls
// task(piece, worker) once for each piece, on up to `threads` threads: the caller, which is worker 0, and the pool's.
//
// Pieces are taken from a shared counter, and the caller takes them, too. So a thread that the scheduler has put aside
// delays nobody, unless it holds a piece: keep pieces short. Where that costs more than the pool brings, the caller
// works alone for a while (Crew). A second caller finds the pool taken and does its pieces alone, too. Results must not
// depend on which thread does a piece, nor on how many there are.
#pragma once

#include <algorithm>
#include <atomic>
#include <chrono>
#include <condition_variable>
#include <cstdint>
#include <exception>
#include <memory>
#include <mutex>
#include <stdexcept>
#include <thread>
#include <utility>
#include <vector>

#include "crew.hpp"

namespace splatam {

class ThreadPool {
 public:
  // It is never destroyed: at the end of the process its threads may still be asleep in it.
  static ThreadPool& of_process() {
    static ThreadPool* const pool = new ThreadPool;
    return *pool;
  }

  ThreadPool(const ThreadPool&) = delete;
  ThreadPool& operator=(const ThreadPool&) = delete;

  // Starts threads until `threads` can work at once, the caller included. Throws std::system_error if the system has no
  // more.
  void reserve(int threads) {
    std::lock_guard<std::mutex> lock(mutex_);
    while (int(workers_.size()) < threads - 1) {
      auto worker = std::make_unique<Worker>();
      worker->index = int(workers_.size()) + 1;
      workers_.reserve(workers_.size() + 1);
      std::thread([this, self = worker.get()] { work(*self); }).detach();
      workers_.push_back(std::move(worker));
    }
  }

  // Returns when all pieces are done. What a task throws ends its piece; the pieces that nobody has begun are left out,
  // and the first exception is thrown again here.
  template <typename Task>
  void run(int threads, std::size_t pieces, const Task& task) {
    if (pieces > kMostPieces) throw std::length_error("too many pieces of work");
    std::unique_lock<std::mutex> turn(turn_, std::defer_lock);
    if (threads == 1 || pieces < 2 || !turn.try_lock()) {
      for (std::size_t piece = 0; piece < pieces; ++piece) task(piece, 0);
      return;
    }
    const auto begin = Clock::now();
    const Nanoseconds before = time_on_core();
    if (!crew_.has_helpers()) {
      for (std::size_t piece = 0; piece < pieces; ++piece) task(piece, 0);
      crew_.note(Clock::now() - begin, time_on_core() - before);
      return;
    }
    const Job job{[](const void* of, std::size_t piece, int worker) { (*static_cast<const Task*>(of))(piece, worker); },
                  &task, pieces};
    const Nanoseconds mine = share(job, std::min<std::size_t>(threads, pieces)) - before;
    crew_.note(Clock::now() - begin, mine + Nanoseconds(helped_.exchange(0, std::memory_order_relaxed)));
  }

 private:
  using Clock = std::chrono::steady_clock;
  using Ticks = Clock::duration;
  static constexpr std::size_t kMostPieces = 0xffffffff;
  static constexpr Ticks kShortestWait = std::chrono::microseconds(2), kLongestWait = std::chrono::microseconds(50);

  struct Job {
    void (*call)(const void* task, std::size_t piece, int worker);
    const void* task;
    std::size_t pieces;
  };

  struct Worker {
    int index;
    bool asleep = false;  // under mutex_
    std::condition_variable wake;
  };

  ThreadPool() = default;
  ~ThreadPool() = default;

  // Returns when all pieces are done, and time_on_core() when the caller found none left to take.
  Nanoseconds share(const Job& job, std::size_t threads) {
    job_ = job;
    failure_ = nullptr;
    failed_.store(false, std::memory_order_relaxed);
    unfinished_.store(job.pieces, std::memory_order_relaxed);
    limit_.store(int(threads), std::memory_order_relaxed);
    const std::uint64_t generation = (tickets_.load(std::memory_order_relaxed) >> 32) + 1;
    tickets_.store(generation << 32 | job.pieces, std::memory_order_release);
    {
      std::lock_guard<std::mutex> lock(mutex_);
      for (std::size_t i = 0; i < std::min(workers_.size(), threads - 1); ++i)
        if (workers_[i]->asleep) workers_[i]->wake.notify_one();
    }
    const auto begin = Clock::now();
    std::size_t mine = 0;
    while (do_piece(0)) ++mine;
    // Another thread needs about as long for its piece as this one did for each of its own. One that takes longer has
    // been put aside, maybe for this thread, which then does better to sleep: it is woken before those that do not.
    const Ticks usual = (Clock::now() - begin) / Ticks::rep(std::max<std::size_t>(mine, 1));
    const Nanoseconds on_core = time_on_core();
    const auto is_done = [this] { return unfinished_.load(std::memory_order_acquire) == 0; };
    if (!spin(2 * usual + kShortestWait, is_done)) {
      std::unique_lock<std::mutex> lock(mutex_);
      finished_.wait(lock, is_done);
    }
    if (failure_) std::rethrow_exception(std::exchange(failure_, nullptr));
    return on_core;
  }

  // Takes a piece and does it. Returns false if none is left, or none for this worker. tickets_ holds the number of the
  // job and, below, how many pieces are left to take. Who has taken one may read job_: it stays until all are done.
  bool do_piece(int worker) {
    std::uint64_t tickets = tickets_.load(std::memory_order_acquire);
    do {
      if (std::uint32_t(tickets) == 0 || worker >= limit_.load(std::memory_order_relaxed)) return false;
    } while (!tickets_.compare_exchange_weak(tickets, tickets - 1, std::memory_order_acq_rel));
    const std::size_t piece = job_.pieces - std::uint32_t(tickets);
    if (!failed_.load(std::memory_order_relaxed)) {
      try {
        job_.call(job_.task, piece, worker);
      } catch (...) {
        std::lock_guard<std::mutex> lock(mutex_);
        if (!failed_.exchange(true)) failure_ = std::current_exception();
      }
    }
    if (unfinished_.fetch_sub(1, std::memory_order_acq_rel) == 1 && worker != 0) {
      std::lock_guard<std::mutex> lock(mutex_);
      finished_.notify_one();
    }
    return true;
  }

  bool is_work_for(int worker) const {
    return std::uint32_t(tickets_.load(std::memory_order_acquire)) != 0 &&
           worker < limit_.load(std::memory_order_relaxed);
  }

  void work(Worker& self) {
    const auto is_work = [&] { return is_work_for(self.index); };
    Ticks wait = kLongestWait;
    for (;;) {
      const Nanoseconds before = time_on_core();
      bool helped = false;
      while (do_piece(self.index)) helped = true;
      if (helped) helped_.fetch_add((time_on_core() - before).count(), std::memory_order_relaxed);
      // The stages of a render follow one another faster than a thread can be woken. Where it did not pay to wait for
      // the next one, the wait is shorter the next time.
      if (spin(wait, is_work)) {
        wait = std::min(2 * wait, kLongestWait);
        continue;
      }
      wait = std::max(wait / 2, kShortestWait);
      std::unique_lock<std::mutex> lock(mutex_);
      self.asleep = true;
      self.wake.wait(lock, is_work);
      self.asleep = false;
    }
  }

  // Waits without giving up the core. Returns whether the condition holds in time.
  template <typename Condition>
  static bool spin(Ticks limit, const Condition& holds) {
    const auto end = Clock::now() + limit;
    do {
      for (int i = 0; i < 16; ++i) {
        if (holds()) return true;
        relax();
      }
    } while (Clock::now() < end);
    return false;
  }

  static void relax() {
#if defined(__x86_64__)
    __builtin_ia32_pause();
#elif defined(__aarch64__)
    asm volatile("yield");
#endif
  }

  std::mutex turn_;  // held by the caller whose job the pool does
  Crew crew_;        // under turn_
  std::mutex mutex_;
  std::vector<std::unique_ptr<Worker>> workers_;
  std::condition_variable finished_;
  Job job_{};
  std::exception_ptr failure_;
  std::atomic<bool> failed_{false};
  std::atomic<int> limit_{0};
  std::atomic<std::uint64_t> tickets_{0};
  std::atomic<std::size_t> unfinished_{0};
  std::atomic<Nanoseconds::rep> helped_{0};  // for how long threads of the pool have worked on pieces
};

}  // namespace splatam
