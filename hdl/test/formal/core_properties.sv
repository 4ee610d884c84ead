// What a machine never does, whatever its tables and seeds hold and whatever the host does: proved by induction.
module core_properties #(parameter REPLICAS = 1) (
  input clk, input rst, input start, input resume, input reset, input [2:0] target, input [63:0] max_cycles,
  input [63:0] run_until, input [REPLICAS-1:0] halt, input [16*REPLICAS-1:0] addresses);

  wire running, done, has_run;
  wire [63:0] cycles;
  wire [2:0] reason;
  wire [REPLICAS-1:0] ready;
  wire [3*REPLICAS-1:0] replica_reasons;
  wire [64*REPLICAS-1:0] replica_cycles;
  wire [6*REPLICAS-1:0] counts;

  core_under_proof core (
    .clk_i(clk), .rst_i(rst), .start_i(start), .resume_i(resume), .reset_i(reset), .target_i(target),
    .max_cycles_i(max_cycles), .run_until_i(run_until), .halt_i(halt), .addresses_i(addresses), .running_o(running),
    .done_o(done), .has_run_o(has_run), .cycles_o(cycles), .reason_o(reason), .ready_o(ready),
    .replica_reasons_o(replica_reasons), .replica_cycles_o(replica_cycles), .counts_o(counts));

  wire accepted = (start | resume) & ~reset & ~rst & ~running;

  reg began = 0, pending = 0, was_quiet = 0;
  reg [2:0] frame_target = 0;
  reg [63:0] frame_max = 0;
  reg [63:0] cycles_before;
  reg [2:0] reason_before;
  reg [6*REPLICAS-1:0] counts_before;
  reg [3*REPLICAS-1:0] reasons_before;
  reg [64*REPLICAS-1:0] replica_cycles_before;

  always @(posedge clk) begin
    began <= 1;
    was_quiet <= ~running & ~accepted & ~reset & ~rst;
    cycles_before <= cycles;
    reason_before <= reason;
    counts_before <= counts;
    reasons_before <= replica_reasons;
    replica_cycles_before <= replica_cycles;
    if (start & accepted) begin
      frame_target <= target;
      frame_max <= max_cycles;
    end
    if (rst | reset | done) pending <= 0;
    else if (accepted) pending <= 1;
  end

  always @* begin
    assume (began | rst);
    // the guard refuses a start with anything else
    if (start) assume (target != 0 && max_cycles != 0);
  end

  genvar at;
  generate for (at = 0; at < 2 * REPLICAS; at = at + 1) begin : each_counter
    // a counter never passes the target
    always @* if (began) assert (counts[3*at +: 3] <= frame_target);
  end endgenerate

  always @* if (began) begin
    // between a start and its done, or a reset, the machine runs; nothing else makes it run, and nothing else is done
    assert (pending == running);
    assert (!done || pending);
    // no frame is longer than it may be
    assert (cycles <= frame_max);
    // no result changes after done
    if (was_quiet) begin
      assert (counts == counts_before);
      assert (cycles == cycles_before);
      assert (reason == reason_before);
      assert (replica_reasons == reasons_before);
      assert (replica_cycles == replica_cycles_before);
    end
  end

`ifdef BOUNDED
  // every start ends: with 2 seeds to load and 4 cycles at most, within this many clocks
  reg [4:0] age = 0;
  always @(posedge clk) age <= running & ~reset & ~rst ? age + 1 : 0;
  always @* begin
    assume (max_cycles <= 4);
    if (began) assert (age < 12);
  end
`endif
endmodule
